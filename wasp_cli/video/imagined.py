"""What a decision imagines, in full: the latents along rollouts of the commands alone and of a correction, as the gates imagine them.

`methods.wasp.imagine` keeps only their returns. S = sequences (alone, corrected), M = rollouts, H = horizon, L = residual steps,
A = action size, K = the operator's draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.learning.sampling import generator, gumbel
from wasp_cli.models.base import Latent
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import DrawnNoise, Operator

ROLLOUTS = 6
"""M: enough to show how far imagined futures lie apart."""


class Outset(NamedTuple):
    """A decision from which futures are imagined."""

    t: int
    latent: Latent
    """[1, .] filtered"""
    a_h: NDArray[np.float32]
    """[A]"""
    operator: Operator
    """forked from the real one right after its command: S * M rows, sequence after sequence"""
    residuals: NDArray[np.float32]
    """[S, L, A]: the first sequence is that of the commands alone, all zero"""


class Ways(NamedTuple):
    """Imagined futures of one decision."""

    features: NDArray[np.float32]
    """[S, M, H, F] of the arrived latents"""
    cost: NDArray[np.float32]
    """[S, H] probability of a cost at the arrived states, mean over the rollouts"""
    images: dict[int, NDArray[np.float32]]
    """by imagined step from 1 to H: [S, 6, 64, 64] in [0, 1], decoded from the first rollout"""


def outset(
    t: int, latent: Latent, row: int, a_h: NDArray[np.float32], operator: Operator, residuals: NDArray[np.float32] | None, horizon: int
) -> Outset:
    """The outset of row `row`; `residuals` [L, A] are those of a correction, None where there is none.

    The sequences share the draws of their rollouts, and the draws of a decision depend on `t` alone.
    """
    nothing = np.zeros((1, *np.shape(residuals)), np.float32) if residuals is not None else np.zeros((1, 1, len(a_h)), np.float32)
    sequences = nothing if residuals is None else np.concatenate([nothing, residuals[None].astype(np.float32)])
    draws = torch.rand((horizon, ROLLOUTS, operator.draws), generator=generator(2 * t)).repeat(1, len(sequences), 1)
    forked = operator.fork(torch.tensor([row]), len(draws[0]), DrawnNoise(draws))
    return Outset(t, latent.rows(torch.tensor([row])), a_h, forked, sequences)


@torch.inference_mode()
def imagined(model: SafetyWorldModel, start: Outset, horizon: int, shown: Sequence[int], *, hold: bool = False) -> Ways:
    """Imagine the sequences of an outset; the same again gives the same.

    Args:
        model: the frozen world model.
        start: where it begins.
        horizon: H.
        shown: imagined steps whose image is decoded.
        hold: residuals are added to the present command instead of the imagined ones (`composition`).
    """
    sequences, steps, _ = start.residuals.shape
    begun = start.operator.snapshot()
    rows = sequences * ROLLOUTS
    noise = gumbel((horizon, ROLLOUTS, model.noise_size), generator(2 * start.t + 1)).repeat(1, sequences, 1)
    residuals = torch.from_numpy(start.residuals).repeat_interleave(ROLLOUTS, 0)  # [S * M, L, A]
    now = torch.from_numpy(start.a_h).expand(rows, -1)
    latent = start.latent.expand_rows(rows)
    features: list[Tensor] = []
    costs: list[Tensor] = []
    images: dict[int, NDArray[np.float32]] = {}
    for k in range(horizon):
        command = now if k == 0 else start.operator.command(latent.features)
        action = ((now if hold else command) + residuals[:, k]).clamp(-1, 1) if k < steps else command
        latent = model.imagine(latent, action, noise[k])
        features.append(latent.features)
        costs.append(model.cost(latent).view(sequences, ROLLOUTS).mean(1))
        if k + 1 in shown:
            images[k + 1] = model.decode(latent.rows(torch.arange(sequences) * ROLLOUTS)).numpy()
    start.operator.restore(begun)
    whole = torch.stack(features, 1).unflatten(0, (sequences, ROLLOUTS))
    return Ways(whole.numpy(), torch.stack(costs, 1).numpy(), images)
