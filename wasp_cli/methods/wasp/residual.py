"""Model-predictive residual planning (section 4.3): constrained CEM with Case I and Case II (Eq. 13-18)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.gates import safe_score, task_score
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Returns, Situation


class Plan(NamedTuple):
    """The selected residual sequences."""

    residuals: Tensor
    """[B, L, A]"""
    found_safe: Tensor
    """[B] whether any candidate of any iteration was feasible"""
    safe: Tensor
    """[B] |F_s| of the last iteration"""
    case2_share: Tensor
    """[B] share of the iterations in Case II"""


@dataclass
class _Search:
    """State of the search over B decisions."""

    mean: Tensor
    """[B, L, A]"""
    std: Tensor
    best_task: Tensor
    """[B] highest S_task among feasible candidates so far"""
    best_safe: Tensor
    """[B] lowest S_safe so far"""
    plan_task: Tensor
    """[B, L, A]"""
    plan_safe: Tensor
    safe: Tensor
    case2: Tensor


def propose(mean: Tensor, std: Tensor, normals: Tensor) -> Tensor:
    """Candidates [B, N, L, A]: the first without residual, the second the mean, the others sampled.

    Args:
        mean, std: [B, L, A].
        normals: standard normal [B, N, L, A].
    """
    sampled = (mean.unsqueeze(1) + std.unsqueeze(1) * normals).clamp(-2, 2)
    sampled[:, 0] = 0
    if sampled.shape[1] > 1:
        sampled[:, 1] = mean
    return sampled


def plan_residuals(
    imagination: Imagination,
    start: Situation,
    mean: Tensor,
    normals: Tensor,
    draws: Draws,
    tau_c: float,
    first: tuple[Tensor, Returns] | None = None,
) -> Plan:
    """Optimise residual sequences for B decisions.

    Args:
        imagination: the frozen models.
        start: B decisions.
        mean: first mean [B, L, A] (zeros, or the last plan shifted).
        normals: standard normal [B, I, N, L, A].
        draws: of M rollouts, common to all candidates and iterations.
        tau_c: bound of the cost return (Eq. 14).
        first: candidates [B, N', L, A] and returns of a batch that already has been evaluated; it is the first iteration.
    """
    config = imagination.config
    search = _Search(
        mean=mean, std=torch.full_like(mean, config.initial_std),
        best_task=mean.new_full((len(mean),), -torch.inf), best_safe=mean.new_full((len(mean),), torch.inf),
        plan_task=torch.zeros_like(mean), plan_safe=torch.zeros_like(mean),
        safe=mean.new_zeros(len(mean)), case2=mean.new_zeros(len(mean)),
    )  # fmt: skip
    for i in range(normals.shape[1]):
        if i == 0 and first is not None:
            candidates, returns = first
        else:
            candidates = propose(search.mean, search.std, normals[:, i])
            returns = imagination.returns(start, candidates, draws)
        _update(search, candidates, returns, config, tau_c)
    found = search.best_task > -torch.inf
    chosen = torch.where(found.view(-1, 1, 1), search.plan_task, search.plan_safe)
    if config.variant == "no-case2":
        # Case I only: without a feasible candidate there is nothing to choose, and the command stays.
        chosen = torch.where(found.view(-1, 1, 1), search.plan_task, torch.zeros_like(chosen))
    return Plan(chosen, found, search.safe, search.case2 / normals.shape[1])


def _update(search: _Search, candidates: Tensor, returns: Returns, config: WASPConfig, tau_c: float) -> None:
    """One CEM iteration: classify the batch, remember the best, refit the distribution to the elites."""
    s_task = task_score(returns, config.alpha)
    s_safe = safe_score(returns, config.alpha, tau_c)
    feasible = returns.cost <= tau_c  # F_s of Eq. 14
    search.safe = feasible.sum(-1).to(s_task.dtype)
    enough = search.safe >= config.feasible  # Case I
    search.case2 = search.case2 + (~enough).to(s_task.dtype)

    ranked_task = torch.where(feasible, s_task, -torch.inf)
    _remember(search, candidates, ranked_task, s_safe)

    if config.variant == "no-case2":
        score, wanted = ranked_task, search.safe.clamp(max=config.elites)
    else:
        score = torch.where(enough.unsqueeze(-1), ranked_task, -s_safe)
        wanted = torch.where(enough, search.safe.clamp(max=config.elites), torch.full_like(search.safe, config.feasible))
    size = min(max(config.elites, config.feasible), candidates.shape[1])
    top = score.topk(size, -1)
    # A fixed number of ranks and a mask instead of gathered subsets: no row can borrow an elite that is none.
    rank = torch.arange(size, device=score.device)
    weight = ((rank < wanted.unsqueeze(-1)) & top.values.isfinite()).to(s_task.dtype)  # [B, size]
    total = weight.sum(-1, keepdim=True).clamp(min=1).unsqueeze(-1)  # [B, 1, 1]
    index = top.indices.view(*top.indices.shape, 1, 1).expand(-1, -1, *candidates.shape[2:])
    elites = candidates.gather(1, index)  # [B, size, L, A]
    share = weight.view(*weight.shape, 1, 1)
    mean = (share * elites).sum(1) / total
    std = ((share * (elites - mean.unsqueeze(1)).square()).sum(1) / total).sqrt().clamp(min=config.std_floor)
    some = (weight.sum(-1) > 0).view(-1, 1, 1)
    search.mean = torch.where(some, config.momentum * search.mean + (1 - config.momentum) * mean, search.mean)
    search.std = torch.where(some, std, search.std)


def _remember(search: _Search, candidates: Tensor, ranked_task: Tensor, s_safe: Tensor) -> None:
    """Keep the best candidate over all iterations, by either score."""
    rows = torch.arange(len(candidates), device=candidates.device)
    task, task_index = ranked_task.max(-1)
    better = task > search.best_task
    search.best_task = torch.where(better, task, search.best_task)
    search.plan_task = torch.where(better.view(-1, 1, 1), candidates[rows, task_index], search.plan_task)
    safe, safe_index = s_safe.min(-1)
    lower = safe < search.best_safe
    search.best_safe = torch.where(lower, safe, search.best_safe)
    search.plan_safe = torch.where(lower.view(-1, 1, 1), candidates[rows, safe_index], search.plan_safe)
