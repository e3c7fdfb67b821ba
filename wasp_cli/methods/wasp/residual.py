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
    """[B] whether the selected sequence is feasible"""
    safe: Tensor
    """[B] |F_s| of the last iteration"""
    case2_share: Tensor
    """[B] share of the iterations with fewer than N_f safe candidates"""


class Pool(NamedTuple):
    """The best K sequences over all iterations by one score, best first."""

    score: Tensor
    """[B, K]"""
    plans: Tensor
    """[B, K, L, A]"""

    def add(self, score: Tensor, candidates: Tensor) -> Pool:
        """Take the best of a batch in: scores [B, N], candidates [B, N, L, A]."""
        size = self.score.shape[1]
        best = torch.cat([self.score, score], 1).topk(size, 1)
        everything = torch.cat([self.plans, candidates], 1)
        return Pool(best.values, everything.gather(1, _over_plans(best.indices, everything)))


@dataclass
class _Search:
    """State of the search over B decisions."""

    mean: Tensor
    """[B, L, A]"""
    std: Tensor
    task: Pool
    """by S_task among feasible candidates"""
    recovery: Pool
    """by -S_safe among all"""
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
    fresh: Draws | None = None,
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
        fresh: rollouts for scoring the finalists again. The best of some thousand estimates is biased: most plans that looked
            safe in the search are not on other draws. Without them the best as scored is selected, as the paper says.
    """
    config = imagination.config
    size = max(1, config.finalists)
    nothing = Pool(mean.new_full((len(mean), size), -torch.inf), torch.zeros_like(mean).unsqueeze(1).repeat(1, size, 1, 1))
    search = _Search(
        mean=mean, std=torch.full_like(mean, config.initial_std), task=nothing, recovery=nothing,
        safe=mean.new_zeros(len(mean)), case2=mean.new_zeros(len(mean)),
    )  # fmt: skip
    for i in range(normals.shape[1]):
        if i == 0 and first is not None:
            candidates, returns = first
        else:
            candidates = propose(search.mean, search.std, normals[:, i])
            returns = imagination.returns(start, candidates, draws)
        _update(search, candidates, returns, config, tau_c)
    task, recovery = search.task, search.recovery
    if fresh is not None:
        finalists = torch.cat([torch.zeros_like(mean).unsqueeze(1), task.plans, recovery.plans], 1)
        again = imagination.returns(start, finalists, fresh)
        feasible = again.cost <= tau_c
        empty = Pool(task.score[:, :1].new_full((len(mean), 1), -torch.inf), torch.zeros_like(finalists[:, :1]))
        task = empty.add(torch.where(feasible, task_score(again, config.alpha), -torch.inf), finalists)
        recovery = empty.add(-safe_score(again, config.alpha, tau_c), finalists)
    found = task.score[:, 0] > -torch.inf
    # Case I only: without a feasible candidate there is nothing to choose, and the command stays.
    otherwise = torch.zeros_like(mean) if config.variant == "no-case2" else recovery.plans[:, 0]
    chosen = torch.where(found.view(-1, 1, 1), task.plans[:, 0], otherwise)
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
    search.task = search.task.add(ranked_task, candidates)
    search.recovery = search.recovery.add(-s_safe, candidates)

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
    elites = candidates.gather(1, _over_plans(top.indices, candidates))  # [B, size, L, A]
    share = weight.view(*weight.shape, 1, 1)
    mean = (share * elites).sum(1) / total
    std = ((share * (elites - mean.unsqueeze(1)).square()).sum(1) / total).sqrt().clamp(min=config.std_floor)
    some = (weight.sum(-1) > 0).view(-1, 1, 1)
    search.mean = torch.where(some, config.momentum * search.mean + (1 - config.momentum) * mean, search.mean)
    search.std = torch.where(some, std, search.std)


def _over_plans(index: Tensor, plans: Tensor) -> Tensor:
    """Indices [B, K] into the second dimension of [B, N, L, A], shaped for `gather`."""
    return index.view(*index.shape, 1, 1).expand(-1, -1, *plans.shape[2:])
