"""Model-predictive residual planning (section 4.3): constrained CEM with Case I and Case II (Eq. 13-18)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.candidates import Batch, is_plan, propose
from wasp_cli.methods.wasp.gates import safe_score, task_score
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Returns, Situation
from wasp_cli.metrics.episode import CUT_OFF

BEHIND, EXCLUDED = -1e4, -1e6
"""Scores in a ranking by S_task: of an infeasible sequence, behind all feasible ones; of one that is a finalist anyway."""


class Plan(NamedTuple):
    """The selected residual sequences and how the search went."""

    residuals: Tensor
    """[B, L, A]"""
    found_safe: Tensor
    """[B] whether the selected sequence is feasible"""
    safe: Tensor
    """[B, I] |F_s| of every iteration; CUT_OFF for those that were left out"""
    case2: Tensor
    """[B, I] whether it was fewer than N_f"""
    predicted: Returns
    """of the selected sequence [B], on the rollouts that decided"""
    alone: Returns
    """of the commands without residuals [B], on the same rollouts"""


@dataclass
class _Search:
    """State of the search over B decisions."""

    mean: Tensor
    """[B, L, A]"""
    std: Tensor
    elites: Batch | None = None
    """the best of the last iteration, which stay candidates"""
    seen: list[Batch] = field(default_factory=list)
    """every batch that was evaluated, once"""
    safe: list[Tensor] = field(default_factory=list)
    """[B] of every iteration"""


def plan_residuals(
    imagination: Imagination,
    start: Situation,
    mean: Tensor,
    normals: Tensor,
    draws: Draws,
    tau_c: float,
    *,
    first: Batch | None = None,
    besides: Batch | None = None,
    fresh: Draws | None = None,
    kept: Tensor | None = None,
    time_is_up: Callable[[], bool] | None = None,
    gate: Returns | None = None,
) -> Plan:
    """Search residual sequences for B decisions by constrained CEM (section 4.3).

    Args:
        imagination: the frozen models.
        start: B decisions.
        mean: first mean [B, L, A] (zeros, or the last plan shifted).
        normals: standard normal [B, I, N, L, A].
        draws: of M rollouts, common to all candidates and iterations.
        tau_c: bound of the cost return (Eq. 14).
        first: a batch that already has been evaluated; it is the first iteration.
        besides: candidates that already have been evaluated (takeovers); they join the first iteration.
        fresh: rollouts for scoring the finalists again. The best of some thousand estimates is biased: most plans that looked
            safe in the search are not on other draws. Without them the best as scored is selected, as the paper says.
        kept: a sequence [B, L, A] that is a candidate and a finalist too, whatever the search thinks of it: the shifted plan of an earlier
            recovery, so that an escape once begun is not given up for one that is no better. Zeros where there is none.
        time_is_up: asked before every further batch of rollouts; once it says so the best so far is selected, on the draws of the search.
            None: the search is never cut off.
        gate: of the commands without residuals [B], as the gates saw them; a search that is cut off compares with these.
    """
    config = imagination.config
    search = _Search(mean, torch.full_like(mean, config.initial_std))
    over = False
    for i in range(normals.shape[1]):
        over = time_is_up is not None and time_is_up()
        if over and i:
            break
        if i == 0 and first is not None:
            batch = first
        elif over and besides is not None:
            batch, besides = besides, None  # nothing is sampled any more: the takeovers are all there is
        else:
            # Sample candidates, and imagine the composed behaviour of each (Eq. 13).
            own = normals[:, i, : config.population(i)]
            candidates = propose(
                search.mean, search.std, own, kept if i == 0 else None, nothing=config.forced and i == 0, centre=config.forced
            )
            batch = Batch(candidates, None, imagination.returns(start, candidates, draws))
        if i == 0 and besides is not None:
            batch = Batch.joined([batch, besides])
        search.seen.append(batch)
        # Score them, choose the case, refit to the elites (Eq. 14-17).
        _update(search, batch, config, tau_c)
    everything = search.seen[-1] if config.best_of == "last" else Batch.joined(search.seen)

    # Finalists: the best plans of all iterations by either score, scored again with fresh rollouts, beside the commands alone.
    over = over or (time_is_up is not None and time_is_up())
    if over and gate is not None:
        # No rollouts any more: the commands alone are a finalist as the gates saw them.
        nothing = Batch(torch.zeros_like(mean).unsqueeze(1), None, Returns(*(values.unsqueeze(1) for values in gate)))
        finalists, alone = Batch.joined([everything, nothing]), gate
    elif fresh is None:
        finalists = everything
        alone = imagination.nominal(start, draws)
    else:
        finalists = _finalists(everything, search.mean, kept, config, tau_c)
        again = imagination.returns(start, finalists.residuals, fresh, *_shares(finalists), alone=1)
        finalists = finalists._replace(returns=again)
        alone = Returns(*(values[:, 0] for values in again))

    # Select: the best feasible plan by S_task (Eq. 16), else the one of lowest S_safe (Eq. 17).
    s_task, s_safe, feasible = _scores(finalists.returns, config, tau_c)
    found = (feasible & s_task.isfinite()).any(-1)
    chosen = torch.where(found, torch.where(feasible, s_task, -torch.inf).argmax(-1), s_safe.argmin(-1))
    best = finalists.take(chosen.unsqueeze(1))
    residuals, predicted = best.residuals.squeeze(1), Returns(*(values.squeeze(1) for values in best.returns))
    # Where every score is undefined the command stands; the same without a feasible candidate where only Case I is allowed.
    stands = ~found & ~(s_safe.amin(-1).isfinite())
    if config.variant == "no-case2":
        stands = ~found
    residuals = torch.where(stands.view(-1, 1, 1), 0.0, residuals)
    predicted = Returns(*(torch.where(stands, *values) for values in zip(alone, predicted, strict=True)))
    safe = torch.stack(search.safe, 1)
    case2 = safe < config.feasible
    if left_out := normals.shape[1] - safe.shape[1]:
        safe, case2 = F.pad(safe, (left_out, 0), value=float(CUT_OFF)), F.pad(case2, (left_out, 0))
    return Plan(residuals, found, safe, case2, predicted, alone)


def _shares(batch: Batch) -> tuple[Tensor, ...]:
    return () if batch.share is None else (batch.share,)


def _scores(returns: Returns, config: WASPConfig, tau_c: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return S_task (Eq. 16), S_safe (Eq. 17) and the feasible set (Eq. 14), [B, N] each."""
    return task_score(returns, config.alpha), safe_score(returns, config.alpha, tau_c), returns.cost <= tau_c


def _finalists(everything: Batch, mean: Tensor, kept: Tensor | None, config: WASPConfig, tau_c: float) -> Batch:
    """Return no residual, the kept plan (the mean where there is none), and the best of all by S_task and by S_safe: each plan once.

    `returns` of the first ones are not known yet.
    """
    s_task, s_safe, feasible = _scores(everything.returns, config, tau_c)
    always = [torch.zeros_like(mean), *([] if kept is None else [torch.where(is_plan(kept), kept, mean)])]
    # No residual is a candidate too, and so is the kept plan, perhaps twice: they are finalists once.
    there = torch.stack([(everything.residuals == plan.unsqueeze(1)).all(-1).all(-1) for plan in always]).any(0)
    if everything.share is not None:
        there = there & ~(everything.share > 0).any(-1).any(-1)
    size = min(config.finalists, everything.residuals.shape[1] // 2)
    # Behind the feasible ones come those that violate least.
    by_task = torch.where(feasible, s_task, BEHIND - s_safe.clamp(max=-BEHIND))
    best_task = torch.where(there, EXCLUDED, by_task.nan_to_num(nan=EXCLUDED)).topk(size, 1).indices
    taken = torch.zeros_like(there).scatter(1, best_task, torch.ones_like(best_task, dtype=torch.bool))
    by_safe = -s_safe.clamp(max=-BEHIND)
    best_safe = torch.where(there | taken, EXCLUDED, by_safe.nan_to_num(nan=EXCLUDED)).topk(size, 1).indices
    ranked = everything.take(torch.cat([best_task, best_safe], 1))
    plans = torch.stack(always, 1)
    unknown = Returns(*(values.new_full((len(values), len(always)), torch.nan) for values in everything.returns))
    return Batch.joined([Batch(plans, None, unknown), ranked])


def _update(search: _Search, batch: Batch, config: WASPConfig, tau_c: float) -> None:
    """Run one CEM iteration: classify the batch, refit the distribution to its elites.

    Args:
        search: updated in place.
        batch: N new candidates; the elites kept from the last iteration join them.
        config: the constants.
        tau_c: bound of the cost return (Eq. 14).
    """
    # Score the candidates (Eq. 16-17), and find the feasible set F_s (Eq. 14).
    if search.elites is not None:
        batch = Batch.joined([batch, search.elites])
    s_task, s_safe, feasible = _scores(batch.returns, config, tau_c)
    safe = feasible.sum(-1).to(s_task.dtype)
    search.safe.append(safe)
    enough = safe >= config.feasible  # Case I, else Case II

    # Rank: feasible candidates by S_task in Case I (Eq. 16), all by S_safe in Case II (Eq. 17).
    ranked_task = torch.where(feasible, s_task, -torch.inf)
    if config.variant == "no-case2":
        score, wanted = ranked_task, safe.clamp(max=config.elites)
    else:
        score = torch.where(enough.unsqueeze(-1), ranked_task, -s_safe)
        wanted = torch.where(enough, safe.clamp(max=config.elites), torch.full_like(safe, config.feasible))

    # Elites: a weight of 0 or 1 for each rank.
    size = min(max(config.elites, config.feasible), batch.residuals.shape[1])
    top, order = score.sort(dim=-1, descending=True, stable=True)  # of equal ones the first
    top, order = top[:, :size], order[:, :size]
    # A fixed number of ranks and a mask instead of gathered subsets: no row can borrow an elite that is none.
    rank = torch.arange(size, device=score.device)
    weight = ((rank < wanted.unsqueeze(-1)) & top.isfinite()).to(s_task.dtype)  # [B, size]
    total = weight.sum(-1, keepdim=True).clamp(min=1).unsqueeze(-1)  # [B, 1, 1]

    # Refit mean and standard deviation to them; rows without any keep theirs.
    best = batch.take(order)
    elites = best.residuals  # [B, size, L, A]
    part = weight.view(*weight.shape, 1, 1)
    mean = (part * elites).sum(1) / total
    std = ((part * (elites - mean.unsqueeze(1)).square()).sum(1) / total).sqrt().clamp(min=config.std_floor)
    some = (weight.sum(-1) > 0).view(-1, 1, 1)
    search.mean = torch.where(some, config.momentum * search.mean + (1 - config.momentum) * mean, search.mean)
    search.std = torch.where(some, std, search.std)

    # Keep the best of them as candidates: on the same draws their returns stay what they are.
    staying = min(int(config.elites_kept * config.elites), size)
    if staying:
        index = torch.arange(staying, device=score.device).expand(len(score), -1)
        search.elites = best.take(index)
