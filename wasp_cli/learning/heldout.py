"""Held-out decisions of the unimpaired expert, on disk and in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from wasp_cli.learning.closed_loop import Loop
from wasp_cli.methods.base import Heldout
from wasp_cli.models.base import Latent
from wasp_cli.models.weights import read_tensors


def heldout_rows(loop: Loop) -> Heldout:
    """Decisions of a recorded loop, episode after episode, without those after an episode's end."""
    assert loop.h is not None
    assert loop.z is not None
    alive = torch.from_numpy(loop.alive.T.copy())  # [B, T]
    episode = torch.arange(alive.shape[0]).unsqueeze(1).expand_as(alive)

    def rows(values: torch.Tensor) -> torch.Tensor:
        return values.transpose(0, 1)[alive].clone()

    return Heldout(
        Latent(rows(loop.h), rows(loop.z)), rows(torch.from_numpy(loop.a_h)), rows(torch.from_numpy(loop.reward.astype(np.float32))),
        rows(torch.from_numpy(loop.cost.astype(np.float32))), episode[alive].clone(),
        rows(torch.from_numpy(loop.terminated.astype(np.float32))),
    )  # fmt: skip


def save_heldout(heldout: Heldout, folder: Path) -> None:
    """Write `heldout.safetensors`."""
    latent, *rest = heldout
    named = dict(zip(Heldout._fields[1:], rest, strict=True))
    save_file({"h": latent.h, "z": latent.z, **named}, folder / "heldout.safetensors")


def load_heldout(folder: Path) -> Heldout:
    """The rows of a held-out artifact."""
    t = read_tensors(folder / "heldout.safetensors")
    return Heldout(Latent(t["h"], t["z"]), t["a_h"], t["reward"], t["cost"], t["episode"], t["terminal"])
