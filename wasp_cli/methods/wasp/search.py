"""The search for a correction (section 4.3): constrained CEM over residual sequences, with Case I
and Case II (Eq. 13-17).

B decisions, N candidates, L residual steps, A actions, I iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.imagine import Scored
from wasp_cli.methods.wasp.outcome import Plan, refitted
from wasp_cli.metrics.episode import CUT_OFF

SURVIVORS = 6  # best candidates of an iteration that are candidates of the next one as well
FINALISTS = 4
"""Best plans by either score that are scored again. The best of some hundred estimates is biased:
most of the plans that look safe in the search are not safe on other draws."""


class Scores(NamedTuple):
    """How good N candidates of B decisions are. A candidate whose returns are NaN is the worst."""

    task: Tensor  # [B, N] S_task (Eq. 16), the larger the better
    safe: Tensor  # [B, N] S_safe (Eq. 17), the smaller the better
    feasible: Tensor  # bool [B, N] the candidates in F_s (Eq. 14)


def search(
    score: Callable[[Tensor], Scored],
    rescore: Callable[[Tensor], Scored],
    proposals: Tensor,
    normals: Tensor,
    command_alone: Scored,
    config: WASPConfig,
    tau_c: float,
    tau_r: float,
    time_is_up: Callable[[], bool],
    unit: float = 1.0,
) -> Plan:
    """Search residual sequences for B decisions.

    Args:
        score: imagines candidates [B, N, L, A] on the draws of the gates, so that the command that
            was unsafe there is not suddenly safe.
        rescore: the same on fresh draws.
        proposals: candidates of the first iteration besides the sampled ones [B, K, L, A]; the
            last one is the first mean.
        normals: standard normal [B, I, N, L, A].
        command_alone: the command without a correction as the gates saw it, N = 1.
        config: the settings; sizes and `variant` are read.
        tau_c: bound of the cost return (Eq. 14).
        tau_r: what a plan must gain where the fresh draws say that the command is safe after all.
        time_is_up: asked before every further batch of rollouts. Once it returns True, the best
            candidate so far is selected on the draws of the search.
        unit: of a reward; the effort of a correction has its price in it.

    Returns:
        One plan for each decision; its residuals are zero where the command stands.
    """
    # The distribution that is sampled, of residual sequences [B, L, A].
    mean = proposals[:, -1]
    std = torch.full_like(mean, config.initial_std)

    batches: list[Scored] = []  # the candidates of every iteration
    feasible_counts: list[Tensor] = []  # [B] |F_s| of every iteration
    survivors: Scored | None = None
    for i in range(config.iterations):
        if i > 0 and time_is_up():
            break

        # Sample N residual sequences. Certain candidates take the places of the first ones: no
        # residual, and the proposals or, later, the mean.
        samples = (mean.unsqueeze(1) + std.unsqueeze(1) * normals[:, i]).clamp(-2, 2)
        if i == 0:
            certain = torch.cat([torch.zeros_like(proposals[:, :1]), proposals], 1)
        else:
            certain = torch.stack([torch.zeros_like(mean), mean], 1)
        residuals = torch.cat([certain, samples[:, certain.shape[1] :]], 1)  # [B, N, L, A]

        # Imagine what they lead to. The best candidates of the last iteration compete with them.
        batch = score(residuals)
        batches.append(batch)
        candidates = batch if survivors is None else Scored.joined([batch, survivors])

        # Case I: enough candidates are safe (Eq. 14), and the elites are the best of them by
        # S_task (Eq. 16). Case II: the elites are the candidates of least S_safe (Eq. 17).
        ranks = scores(candidates, config.alpha, tau_c, unit)
        feasible_count = ranks.feasible.sum(-1)  # [B]
        feasible_counts.append(feasible_count)
        by_task = torch.where(ranks.feasible, ranks.task, -torch.inf)
        case1_elites = feasible_count.clamp(max=config.elites)
        if config.variant == "no-case2":
            ranking = by_task
            elite_count = case1_elites
        else:
            case1 = feasible_count >= config.feasible
            ranking = torch.where(case1.unsqueeze(-1), by_task, -ranks.safe)
            elite_count = torch.where(case1, case1_elites, config.feasible)

        # Refit the distribution to the elites. A decision may have fewer of them than another, so
        # the same number of ranks is taken for all, and a mask leaves out those that are no elites.
        top, order = ranking.sort(dim=-1, descending=True, stable=True)
        size = min(max(config.elites, config.feasible), order.shape[1])
        places = torch.arange(size, device=order.device)
        is_elite = (places < elite_count.unsqueeze(-1)) & top[:, :size].isfinite()
        elite_residuals = candidates.take(order[:, :size]).residuals
        mean, std = refitted(elite_residuals, is_elite, mean, std)
        survivors = candidates.take(order[:, : min(SURVIVORS, size)])

    # Score the best of all iterations by either score again on fresh draws, beside the command
    # alone. Without time for that, every candidate is a finalist as it was scored.
    candidates = Scored.joined(batches)
    if time_is_up():
        finalists = Scored.joined([command_alone, candidates])
    else:
        ranks = scores(candidates, config.alpha, tau_c, unit)
        size = min(FINALISTS, candidates.residuals.shape[1])
        by_task = torch.where(ranks.feasible, ranks.task, -torch.inf)
        best_by_task = by_task.topk(size, 1).indices
        best_by_safe = (-ranks.safe).topk(size, 1).indices
        best = candidates.take(torch.cat([best_by_task, best_by_safe], 1))
        no_residual = torch.zeros_like(mean).unsqueeze(1)
        finalists = rescore(torch.cat([no_residual, best.residuals], 1))
    return _select(finalists, feasible_counts, config, tau_c, tau_r, unit)


def scores(batch: Scored, alpha: float, tau_c: float, unit: float = 1.0) -> Scores:
    """Return how good candidates are by Eq. 14, 16 and 17.

    S_task counts rewards in their `unit`, so that alpha means the same on every task.
    """
    effort = alpha * batch.residuals.square().sum((-1, -2))  # [B, N]
    s_task = batch.reward / unit - effort
    s_safe = (batch.cost - tau_c).clamp(min=0) + effort
    return Scores(
        task=s_task.nan_to_num(nan=-torch.inf),
        safe=s_safe.nan_to_num(nan=torch.inf),
        feasible=batch.cost <= tau_c,
    )


def _select(
    finalists: Scored,
    feasible_counts: list[Tensor],
    config: WASPConfig,
    tau_c: float,
    tau_r: float,
    unit: float,
) -> Plan:
    """Return the plan of every decision: the best feasible finalist by S_task, or else the one of
    least S_safe.

    Args:
        finalists: N candidates; the first one is the command alone.
        feasible_counts: |F_s| [B] of every iteration that was made.
        config: the settings.
        tau_c: bound of the cost return.
        tau_r: what a plan must gain where the command is safe.
        unit: of a reward.
    """
    # The best finalist by the score that counts.
    ranks = scores(finalists, config.alpha, tau_c, unit)
    any_feasible = (ranks.feasible & ranks.task.isfinite()).any(-1)  # [B]
    best_by_task = torch.where(ranks.feasible, ranks.task, -torch.inf).argmax(-1)
    best_by_safe = ranks.safe.argmin(-1)
    index = torch.where(any_feasible, best_by_task, best_by_safe)  # [B]
    best = finalists.take(index.unsqueeze(1))

    # The command stands where the gate fired by chance: it is safe on the fresh draws, and the plan
    # gains too little. It stands as well where every score is undefined, and where no finalist is
    # feasible if Case II is not allowed.
    gain = best.reward.squeeze(1) - finalists.reward[:, 0]
    false_alarm = ranks.feasible[:, 0] & ~(gain > tau_r)
    undefined = ~any_feasible & ~ranks.safe.amin(-1).isfinite()
    command_stands = false_alarm | undefined
    if config.variant == "no-case2":
        command_stands = command_stands | ~any_feasible
    plan = finalists.take(torch.where(command_stands, 0, index).unsqueeze(1))

    # Iterations for which there was no time come first.
    safe = torch.stack(feasible_counts, 1)  # [B, iterations made]
    case2 = safe < config.feasible
    missing = config.iterations - safe.shape[1]
    if missing:
        safe = F.pad(safe, (missing, 0), value=CUT_OFF)
        case2 = F.pad(case2, (missing, 0))
    return Plan(
        residuals=plan.residuals.squeeze(1),
        cost=plan.cost.squeeze(1),
        reward=plan.reward.squeeze(1),
        alone_cost=finalists.cost[:, 0],
        alone_reward=finalists.reward[:, 0],
        safe=safe,
        case2=case2,
    )
