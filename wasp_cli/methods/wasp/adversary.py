"""LUCID's idea in WASP's safety rollouts (Seo and Bajcsy 2026): costs under an adversary that
disturbs the imagined transitions within a calibrated budget.

Both futures of a decision, the command's and the correction's, are imagined a second time on the
same draws with the disturbance of the stage `adversary`. The cost of each is the larger of the two.
The finalists of a search are treated alike; the search itself imagines without the adversary, which
takes a tenth of the time. Rewards are those without the adversary.

What differs from the source:

- It trains the adversary against a safety policy and filters by the robust value of that game. Here
  the adversary is trained against the expert, on the cost that the gate reads.
- Its density is a flow, here it is a Gaussian.
- Its budget is a penalty in training, here it is a bound at every step.

B decisions, N candidates, H horizon, M rollouts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from wasp_cli.methods.base import Parts
from wasp_cli.methods.wasp.imagine import Compose, Draws, Imagination, Imagined, Situation
from wasp_cli.models.adversary import Adversary, DisturbedModel
from wasp_cli.models.weights import load_module

# turns an imagination of N candidates into their costs [B, N]
CostOf = Callable[[Imagined], Tensor]


class Adversity:
    """Costs of futures under the adversary."""

    def __init__(self, imagination: Imagination) -> None:
        """Imagine with `imagination`, whose model is a `DisturbedModel`."""
        self.imagination = imagination

    def raised(
        self,
        cost: Tensor,
        start: Situation,
        compose: Compose,
        draws: Draws,
        cost_of: CostOf,
    ) -> Tensor:
        """Return the costs [B, N] of N candidates: the larger of those with and without the
        adversary.

        Args:
            cost: [B, N] without the adversary, on the same draws.
            start: B decisions.
            compose: what the candidates execute, as `Imagination.roll` takes it.
            draws: of the M rollouts.
            cost_of: summarises an imagination, as it did without the adversary.
        """
        imagined = self.imagination.roll(start, cost.shape[1], compose, draws)
        return torch.maximum(cost, cost_of(imagined))


def adversity_of(parts: Parts, imagination: Imagination, share: float) -> Adversity:
    """Return the adversary of a training chain, with a share of its calibrated budget."""
    path = parts.inputs["adversary"] / "adversary.safetensors"
    adversary = load_module(Adversary, path).to(parts.device)
    disturbed = DisturbedModel(parts.world_model, adversary, share)
    return Adversity(replace(imagination, model=disturbed, pack=False))
