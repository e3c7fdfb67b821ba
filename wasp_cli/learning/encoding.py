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
    """Filter every recorded row as the closed loop would: episodes side by side, the posterior's
    mode.

    Args:
        recording: what the model reads, action, first and episode of N rows.

    Returns:
        N rows on the CPU.
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
            # Rows whose episode is over repeat its last row; what they produce is not stored.
            index = np.array([rows[min(t, len(rows) - 1)] for rows in group])
            action, seen, first = (
                torch.from_numpy(field[index]).to(device)
                for field in (recording.action, recording.seen, recording.first)
            )
            latent = model.filter(latent, action, seen, first)
            live = torch.tensor([t < len(rows) for rows in group])
            keep = torch.from_numpy(index)[live]
            h[keep] = latent.h.cpu()[live]
            z[keep] = (
                latent.z.cpu()[live]
                .unflatten(-1, (model.sizes.variables, -1))
                .argmax(-1)
                .to(torch.uint8)
            )
        done = min(begin + together, len(episodes))
        report(done / len(episodes), f"encoding episode {done}/{len(episodes)}")
    return Latents(h, z, model.sizes.classes)
