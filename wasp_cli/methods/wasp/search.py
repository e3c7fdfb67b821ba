"""The search for a correction (section 4.3): constrained CEM over residual sequences, with Case I
and Case II (Eq. 13-17).

B decisions, N candidates, L residual steps, A actions, I iterations.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.imagine import Scored
from wasp_cli.methods.wasp.outcome import Plan, refitted
from wasp_cli.metrics.episode import CUT_OFF

KEPT = 6  # elites that stay candidates of the next iteration
FINALISTS = 4
"""Best plans by either score that are scored again. The best of some hundred estimates is biased:
of the plans that look safe in the search most are not on other draws."""


def search(
    score: Callable[[Tensor], Scored],
    again: Callable[[Tensor], Scored],
    known: Tensor,
    normals: Tensor,
    alone: Scored,
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
        again: the same on fresh draws.
        known: candidates of the first iteration beside the sampled ones [B, K, L, A]; the last one
            is the first mean.
        normals: standard normal [B, I, N, L, A].
        alone: the command without a correction as the gates saw it, N = 1.
        tau_c: bound of the cost return (Eq. 14).
        tau_r: what a plan must gain where the second look says that the command is safe after all.
        time_is_up: asked before every further batch of rollouts; once it says so, the best so far
            is selected on the draws of the search.
        unit: of a reward; the effort of a correction has its price in it.
    """
    mean, std = known[:, -1], torch.full_like(known[:, -1], config.initial_std)
    everything: list[Scored] = []
    counts: list[Tensor] = []
    kept: list[Scored] = []
    for i in range(config.iterations):
        if i and time_is_up():
            break
        # Sample candidates; beside them stand no residual, the mean, and what is known.
        sampled = (mean.unsqueeze(1) + std.unsqueeze(1) * normals[:, i]).clamp(-2, 2)
        certain = (
            torch.stack([torch.zeros_like(mean), mean], 1)
            if i
            else torch.cat([torch.zeros_like(known[:, :1]), known], 1)
        )
        batch = score(torch.cat([certain, sampled[:, certain.shape[1] :]], 1))
        everything.append(batch)
        batch = Scored.joined([batch, *kept])

        # Case I: enough safe candidates (Eq. 14), the elites are the best by S_task (Eq. 16). Case
        # II: those of least S_safe (Eq. 17).
        s_task, s_safe, feasible = scores(batch, config.alpha, tau_c, unit)
        counts.append(feasible.sum(-1))
        enough = counts[-1] >= config.feasible
        by_task = torch.where(feasible, s_task, -torch.inf)
        if config.variant == "no-case2":
            ranking, wanted = by_task, counts[-1].clamp(max=config.elites)
        else:
            ranking = torch.where(enough.unsqueeze(-1), by_task, -s_safe)
            wanted = torch.where(enough, counts[-1].clamp(max=config.elites), config.feasible)

        # Refit the distribution to the elites. A fixed number of ranks and a mask: no row borrows.
        top, order = ranking.sort(dim=-1, descending=True, stable=True)
        size = min(max(config.elites, config.feasible), order.shape[1])
        elite = (torch.arange(size, device=order.device) < wanted.unsqueeze(-1)) & top[
            :, :size
        ].isfinite()
        mean, std = refitted(batch.take(order[:, :size]).residuals, elite, mean, std)
        kept = [batch.take(order[:, : min(KEPT, size)])]

    # The best of all iterations by either score are scored again on fresh rollouts, beside the
    # command alone.
    found = Scored.joined(everything)
    if time_is_up():
        finalists = Scored.joined([alone, found])
    else:
        s_task, s_safe, feasible = scores(found, config.alpha, tau_c, unit)
        size = min(FINALISTS, found.residuals.shape[1])
        best = torch.where(feasible, s_task, -torch.inf).topk(size, 1), (-s_safe).topk(size, 1)
        index = torch.cat([each.indices for each in best], 1)
        finalists = again(
            torch.cat([torch.zeros_like(mean).unsqueeze(1), found.take(index).residuals], 1)
        )
    return _selected(finalists, counts, config, tau_c, tau_r, unit)


def scores(
    batch: Scored, alpha: float, tau_c: float, unit: float = 1.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Return S_task (Eq. 16), S_safe (Eq. 17), and which candidates are feasible (Eq. 14), [B,
    N] each; a broken rollout is the worst.

    S_task counts rewards in their `unit`, so that alpha means the same on every task.
    """
    effort = alpha * batch.residuals.square().sum((-1, -2))
    s_task = batch.reward / unit - effort
    s_safe = (batch.cost - tau_c).clamp(min=0) + effort
    return s_task.nan_to_num(nan=-torch.inf), s_safe.nan_to_num(nan=torch.inf), batch.cost <= tau_c


def _selected(
    finalists: Scored,
    counts: list[Tensor],
    config: WASPConfig,
    tau_c: float,
    tau_r: float,
    unit: float,
) -> Plan:
    """Select the best feasible finalist by S_task, else the one of least S_safe; the first
    finalist is the command alone.
    """
    s_task, s_safe, feasible = scores(finalists, config.alpha, tau_c, unit)
    some = (feasible & s_task.isfinite()).any(-1)
    index = torch.where(
        some, torch.where(feasible, s_task, -torch.inf).argmax(-1), s_safe.argmin(-1)
    )
    best = finalists.take(index.unsqueeze(1))
    # The command stands where the gate had fired by chance: it is safe on fresh rollouts, and the
    # plan gains nothing. It stands too where every score is undefined, and without a feasible plan
    # where Case II is not allowed.
    gain = best.reward.squeeze(1) - finalists.reward[:, 0]
    stands = (feasible[:, 0] & ~(gain > tau_r)) | (~some & ~s_safe.amin(-1).isfinite())
    if config.variant == "no-case2":
        stands = stands | ~some
    best = finalists.take(torch.where(stands, 0, index).unsqueeze(1))
    safe = torch.stack(counts, 1)
    case2 = safe < config.feasible
    if left_out := config.iterations - safe.shape[1]:
        safe, case2 = F.pad(safe, (left_out, 0), value=CUT_OFF), F.pad(case2, (left_out, 0))
    return Plan(
        best.residuals.squeeze(1),
        best.cost.squeeze(1),
        best.reward.squeeze(1),
        finalists.cost[:, 0],
        finalists.reward[:, 0],
        safe,
        case2,
    )
