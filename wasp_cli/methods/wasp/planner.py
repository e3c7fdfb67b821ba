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
    """The selected residual sequences and how the search went."""

    residuals: Tensor
    """[B, L, A]"""
    found_safe: Tensor
    """[B] whether the selected sequence is feasible"""
    safe: Tensor
    """[B, I] |F_s| of every iteration"""
    case2: Tensor
    """[B, I] whether it was fewer than N_f"""
    predicted: Returns
    """of the selected sequence [B], on the rollouts that decided"""
    alone: Returns
    """of the commands without residuals [B], on the same rollouts"""


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
    safe: list[Tensor]
    """[B] of every iteration"""


def propose(mean: Tensor, std: Tensor, normals: Tensor, kept: Tensor | None = None) -> Tensor:
    """Sample candidates [B, N, L, A]: the first without residual, the second the mean, the third an older plan if there is one.

    Args:
        mean, std: [B, L, A].
        normals: standard normal [B, N, L, A].
        kept: [B, L, A].
    """
    sampled = (mean.unsqueeze(1) + std.unsqueeze(1) * normals).clamp(-2, 2)
    sampled[:, 0] = 0
    if sampled.shape[1] > 1:
        sampled[:, 1] = mean
    if kept is not None and sampled.shape[1] > 2:
        sampled[:, 2] = kept
    return sampled


def plan_residuals(
    imagination: Imagination,
    start: Situation,
    mean: Tensor,
    normals: Tensor,
    draws: Draws,
    tau_c: float,
    *,
    first: tuple[Tensor, Returns] | None = None,
    fresh: Draws | None = None,
    kept: Tensor | None = None,
) -> Plan:
    """Search residual sequences for B decisions by constrained CEM (section 4.3).

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
        kept: a sequence [B, L, A] that is a candidate and a finalist too, whatever the search thinks of it: the shifted plan of an earlier
            recovery, so that an escape once begun is not given up for one that is no better. Zeros where there is none.
    """
    # Begin: the operator alone as the best so far, and the first sampling distribution.
    config = imagination.config
    nothing = torch.zeros_like(mean).unsqueeze(1)  # [B, 1, L, A]
    size = max(1, config.finalists)
    empty = Pool(mean.new_full((len(mean), size), -torch.inf), nothing.repeat(1, size, 1, 1))
    search = _Search(mean, torch.full_like(mean, config.initial_std), empty, empty, [])
    for i in range(normals.shape[1]):
        if i == 0 and first is not None:
            candidates, returns = first
        else:
            # Sample candidates, and imagine the composed behaviour of each (Eq. 13).
            candidates = propose(search.mean, search.std, normals[:, i], kept if i == 0 else None)
            returns = imagination.returns(start, candidates, draws)
        # Score them, choose the case, refit to the elites (Eq. 14-17).
        _update(search, candidates, returns, config, tau_c)

    # Finalists: the best plans of all iterations by either score, scored again with fresh rollouts.
    finalists = torch.cat([nothing, *([] if kept is None else [kept.unsqueeze(1)]), search.task.plans, search.recovery.plans], 1)
    if fresh is None:
        task, recovery = search.task, search.recovery
    else:
        again = imagination.returns(start, finalists, fresh)
        task, recovery = _ranked(finalists, again, config, tau_c)

    # Select: the best feasible plan by S_task (Eq. 16), else the one of lowest S_safe (Eq. 17).
    found = task.score[:, 0] > -torch.inf
    # Case I only: without a feasible candidate there is nothing to choose, and the command stays. The same where every score is undefined.
    otherwise = torch.where(recovery.score[:, 0].isfinite().view(-1, 1, 1), recovery.plans[:, 0], 0.0)
    if config.variant == "no-case2":
        otherwise = torch.zeros_like(mean)
    chosen = torch.where(found.view(-1, 1, 1), task.plans[:, 0], otherwise)

    # Predict the outcome of the selected plan and of the commands alone, on the same rollouts.
    pair = imagination.returns(start, torch.cat([nothing, chosen.unsqueeze(1)], 1), draws if fresh is None else fresh)
    safe = torch.stack(search.safe, 1)
    alone, predicted = (Returns(*(field[:, i] for field in pair)) for i in range(2))
    return Plan(chosen, found, safe, safe < config.feasible, predicted, alone)


def _ranked(plans: Tensor, returns: Returns, config: WASPConfig, tau_c: float) -> tuple[Pool, Pool]:
    """Return the best of a batch by S_task among its feasible ones, and by -S_safe among all."""
    none = Pool(plans.new_full((len(plans), 1), -torch.inf), torch.zeros_like(plans[:, :1]))
    feasible = returns.cost <= tau_c
    by_task = none.add(torch.where(feasible, task_score(returns, config.alpha), -torch.inf), plans)
    return by_task, none.add(-safe_score(returns, config.alpha, tau_c), plans)


def _update(search: _Search, candidates: Tensor, returns: Returns, config: WASPConfig, tau_c: float) -> None:
    """Run one CEM iteration: classify the batch, remember the best, refit the distribution to the elites.

    Args:
        search: updated in place.
        candidates: [B, N, L, A].
        returns: of the candidates, [B, N] each.
        config: the constants.
        tau_c: bound of the cost return (Eq. 14).
    """
    # Score the candidates (Eq. 16-17), and find the feasible set F_s (Eq. 14).
    s_task = task_score(returns, config.alpha)
    s_safe = safe_score(returns, config.alpha, tau_c)
    feasible = returns.cost <= tau_c
    safe = feasible.sum(-1).to(s_task.dtype)
    search.safe.append(safe)
    enough = safe >= config.feasible  # Case I, else Case II

    # Remember the best of all iterations by either score.
    ranked_task = torch.where(feasible, s_task, -torch.inf)
    search.task = search.task.add(ranked_task, candidates)
    search.recovery = search.recovery.add(-s_safe, candidates)

    # Rank: feasible candidates by S_task in Case I (Eq. 16), all by S_safe in Case II (Eq. 17).
    if config.variant == "no-case2":
        score, wanted = ranked_task, safe.clamp(max=config.elites)
    else:
        score = torch.where(enough.unsqueeze(-1), ranked_task, -s_safe)
        wanted = torch.where(enough, safe.clamp(max=config.elites), torch.full_like(safe, config.feasible))

    # Elites: a weight of 0 or 1 for each rank.
    size = min(max(config.elites, config.feasible), candidates.shape[1])
    top = score.topk(size, -1)
    # A fixed number of ranks and a mask instead of gathered subsets: no row can borrow an elite that is none.
    rank = torch.arange(size, device=score.device)
    weight = ((rank < wanted.unsqueeze(-1)) & top.values.isfinite()).to(s_task.dtype)  # [B, size]
    total = weight.sum(-1, keepdim=True).clamp(min=1).unsqueeze(-1)  # [B, 1, 1]

    # Refit mean and standard deviation to them; rows without any keep theirs.
    elites = candidates.gather(1, _over_plans(top.indices, candidates))  # [B, size, L, A]
    share = weight.view(*weight.shape, 1, 1)
    mean = (share * elites).sum(1) / total
    std = ((share * (elites - mean.unsqueeze(1)).square()).sum(1) / total).sqrt().clamp(min=config.std_floor)
    some = (weight.sum(-1) > 0).view(-1, 1, 1)
    search.mean = torch.where(some, config.momentum * search.mean + (1 - config.momentum) * mean, search.mean)
    search.std = torch.where(some, std, search.std)


def _over_plans(index: Tensor, plans: Tensor) -> Tensor:
    """Shape indices [B, K] into the second dimension of [B, N, L, A] for `gather`."""
    return index.view(*index.shape, 1, 1).expand(-1, -1, *plans.shape[2:])
