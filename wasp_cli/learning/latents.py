"""Filtered latents of recorded rows: how they come about, how they are imagined onward, and how they are stored."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from wasp_cli.learning.draws import gumbel
from wasp_cli.learning.replay import Replay
from wasp_cli.models.base import Latent
from wasp_cli.models.weights import read_tensors
from wasp_cli.models.world_model import SafetyWorldModel

Report = Callable[[float, str], None]
SIDE_BY_SIDE = 16
"""Episodes that are filtered together on a CPU."""


class Latents(NamedTuple):
    """Filtered latents of N recorded rows. z is stored as class indices."""

    h: Tensor
    """[N, D]"""
    z: Tensor
    """uint8 [N, S]"""
    classes: int

    def at(self, index: Tensor) -> Latent:
        """Latents of some rows, with z one-hot again."""
        one_hot = torch.nn.functional.one_hot(self.z[index].long(), self.classes).to(torch.float32)
        return Latent(self.h[index].float(), one_hot.flatten(-2))

    def rows(self, mask: Tensor) -> Latents:
        """The latents of a mask [N]."""
        return Latents(self.h[mask], self.z[mask], self.classes)


@torch.inference_mode()
def encode(model: SafetyWorldModel, replay: Replay, report: Report) -> Latents:
    """Filter every recorded row as the closed loop would: episodes side by side, the posterior's mode."""
    device = model.mean_image.device
    episodes = [np.flatnonzero(replay.episode == e) for e in np.unique(replay.episode)]
    h = torch.zeros(len(replay.first), model.sizes.deter)
    z = torch.zeros(len(replay.first), model.sizes.variables, dtype=torch.uint8)
    together = SIDE_BY_SIDE if device.type == "cpu" else len(episodes)
    for begin in range(0, len(episodes), together):
        group = episodes[begin : begin + together]
        latent = model.initial(len(group))
        for t in range(max(len(rows) for rows in group)):
            # Rows whose episode is over repeat its last row; what they produce is not stored.
            index = np.array([rows[min(t, len(rows) - 1)] for rows in group])
            action, pixels, first = (torch.from_numpy(field[index]).to(device) for field in (replay.action, replay.pixels, replay.first))
            latent = model.filter(latent, action, pixels, first)
            live = torch.tensor([t < len(rows) for rows in group])
            keep = torch.from_numpy(index)[live]
            h[keep] = latent.h.cpu()[live]
            z[keep] = latent.z.cpu()[live].unflatten(-1, (model.sizes.variables, -1)).argmax(-1).to(torch.uint8)
        done = min(begin + together, len(episodes))
        report(done / len(episodes), f"encoding episode {done}/{len(episodes)}")
    return Latents(h, z, model.sizes.classes)


def roll_prior(model: SafetyWorldModel, start: Latent, actions: Tensor, source: torch.Generator) -> Latent:
    """Arrived prior latents under given actions [B, H, A]: fields [B, H, .]."""
    noise = gumbel((actions.shape[1], actions.shape[0], model.noise_size), source)
    hs, zs = [], []
    latent = start
    for k in range(actions.shape[1]):
        latent = model.imagine(latent, actions[:, k], noise[k])
        hs.append(latent.h)
        zs.append(latent.z)
    return Latent(torch.stack(hs, 1), torch.stack(zs, 1))


def save_latents(latents: Latents, folder: Path) -> None:
    """Write `latents.safetensors`."""
    save_file({"h": latents.h.half(), "z": latents.z, "classes": torch.tensor(latents.classes)}, folder / "latents.safetensors")


def load_latents(folder: Path) -> Latents:
    """The latents of a world-model artifact, row for row those of its dataset."""
    tensors = read_tensors(folder / "latents.safetensors")
    return Latents(tensors["h"].float(), tensors["z"], int(tensors["classes"]))
