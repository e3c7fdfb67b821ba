"""Candidates that are judged: sampled residual sequences, and takeovers of the next commands by the nominal expert or by a brake.

A takeover is closed-loop: in every rollout the expert reads the imagined latent of the moment, so that its residual
share * (pi_E(h, z) - a^H) answers what the operator does there. B = decisions, N = candidates, T = takeovers, L residual steps, A actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.imagine import Returns


class Batch(NamedTuple):
    """Candidates whose returns are known."""

    residuals: Tensor
    """[B, N, L, A]; of a takeover as they came about in imagination"""
    share: Tensor | None
    """[B, N, L, 2] taken over by the expert and by the brake; None where no candidate is a takeover"""
    returns: Returns
    """[B, N] each"""

    def rows(self, index: Tensor) -> Batch:
        """Select some of the decisions (indices [R])."""
        share = None if self.share is None else self.share[index]
        return Batch(self.residuals[index], share, Returns(*(field[index] for field in self.returns)))

    def take(self, index: Tensor) -> Batch:
        """Select candidates of every decision (indices [B, K])."""
        share = None if self.share is None else self.share.gather(1, over_plans(index, self.share))
        returns = Returns(*(field.gather(1, index) for field in self.returns))
        return Batch(self.residuals.gather(1, over_plans(index, self.residuals)), share, returns)

    @classmethod
    def joined(cls, batches: Sequence[Batch]) -> Batch:
        """Join batches of the same decisions along their candidates."""
        residuals = torch.cat([batch.residuals for batch in batches], 1)
        share = None
        if any(batch.share is not None for batch in batches):
            share = torch.cat([none_taken(batch.residuals) if batch.share is None else batch.share for batch in batches], 1)
        fields = zip(*(batch.returns for batch in batches), strict=True)
        return cls(residuals, share, Returns(*(torch.cat(field, 1) for field in fields)))


def takeovers(config: WASPConfig, batch: int) -> Tensor:
    """Return the shares [B, T, L, 2] of all takeovers: of the next 1..L commands, by each share, then of as many by braking. T may be 0."""
    steps = config.residual_steps
    lengths = torch.ones(steps, steps).tril()  # row n - 1 takes over the first n commands
    kinds = [(share, 0.0) for share in config.takeover_shares] + ([(0.0, 1.0)] if config.braking else [])
    found = torch.zeros(0, steps, 2)
    if kinds:
        found = torch.cat([torch.stack([expert * lengths, brake * lengths], -1) for expert, brake in kinds])
    return found.expand(batch, *found.shape)


def none_taken(residuals: Tensor) -> Tensor:
    """Return shares of candidates [B, N, L, A] that are sequences: zeros [B, N, L, 2]."""
    return residuals.new_zeros(*residuals.shape[:3], 2)


def propose(mean: Tensor, std: Tensor, normals: Tensor, kept: Tensor | None = None, *, nothing: bool = True, centre: bool = True) -> Tensor:
    """Sample candidates [B, N, L, A], and put a few known ones in the place of the first samples.

    Args:
        mean, std: [B, L, A].
        normals: standard normal [B, N, L, A].
        kept: the third candidate, an older plan [B, L, A]; rows of zeros are none.
        nothing: the first candidate has no residual.
        centre: the second candidate is the mean, where there is one.
    """
    sampled = (mean.unsqueeze(1) + std.unsqueeze(1) * normals).clamp(-2, 2)
    if nothing:
        sampled[:, 0] = 0
    if centre and sampled.shape[1] > 1:
        sampled[:, 1] = torch.where(is_plan(mean), mean, sampled[:, 1])
    if kept is not None and sampled.shape[1] > 2:
        sampled[:, 2] = torch.where(is_plan(kept), kept, sampled[:, 2])
    return sampled


def is_plan(plan: Tensor) -> Tensor:
    """Return where plans [B, L, A] have any residual: bool [B, 1, 1]."""
    return (plan != 0).any(-1, keepdim=True).any(-2, keepdim=True)


def over_plans(index: Tensor, plans: Tensor) -> Tensor:
    """Shape indices [B, K] into the second dimension of [B, N, L, C] for `gather`."""
    return index.view(*index.shape, 1, 1).expand(-1, -1, *plans.shape[2:])
