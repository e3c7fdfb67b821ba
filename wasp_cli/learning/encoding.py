"""Filtering of recorded episodes by a world model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from wasp_cli.learning.latents import Latents
from wasp_cli.learning.shards import Recording
from wasp_cli.models.world_model import SafetyWorldModel

Report = Callable[[float, str], None]
SIDE_BY_SIDE = 16  # episodes that are filtered together on a CPU


@torch.inference_mode()
def encode(model: SafetyWorldModel, recording: Recording, report: Report) -> Latents:
    """Filter every recorded row as the closed loop would: episodes side by side, with the mode of
    the posterior.

    Args:
        model: on any device.
        recording: what the model reads, action, first and episode of N rows.
        report: called with the share that is done and a text.

    Returns:
        The latents of the N rows, on the CPU.
    """
    device = model.device
    episodes = [np.flatnonzero(recording.episode == e) for e in np.unique(recording.episode)]
    h = torch.zeros(len(recording.first), model.sizes.deter)
    z = torch.zeros(len(recording.first), model.sizes.variables, dtype=torch.uint8)
    together = SIDE_BY_SIDE if device.type == "cpu" else len(episodes)
    for begin in range(0, len(episodes), together):
        group = episodes[begin : begin + together]
        latent = model.initial(len(group))
        for t in range(max(len(rows) for rows in group)):
            # -- filter; an episode that is over repeats its last row
            index = np.array([rows[min(t, len(rows) - 1)] for rows in group])
            action = torch.from_numpy(recording.action[index]).to(device)
            seen = torch.from_numpy(recording.seen[index]).to(device)
            first = torch.from_numpy(recording.first[index]).to(device)
            latent = model.filter(latent, action, seen, first)

            # -- store the rows of the episodes that are going on
            alive = torch.tensor([t < len(rows) for rows in group])
            rows_alive = torch.from_numpy(index)[alive]
            classes = latent.z.cpu()[alive].unflatten(-1, (model.sizes.variables, -1)).argmax(-1)
            h[rows_alive] = latent.h.cpu()[alive]
            z[rows_alive] = classes.to(torch.uint8)
        done = min(begin + together, len(episodes))
        report(done / len(episodes), f"encoding episode {done}/{len(episodes)}")
    return Latents(h, z, model.sizes.classes)
