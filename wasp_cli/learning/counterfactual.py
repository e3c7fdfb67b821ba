"""Counterfactual branches of the real task (section 5.3 of the paper): what would have happened
without an intervention.

At a chosen decision of a stored episode two branches begin in the same state: `asst` executes the
recorded action, `cf` the operator's command; then both follow the operator alone. Their draws are
those of the episode and the decision (common random numbers). Every branch runs in the row that its
episode had, in a batch of the same size, so that one that does what the episode did gives the same
bits. B = episodes, A = action size, W = decision steps of a branch at most.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.learning.closed_loop import privileged_view
from wasp_cli.learning.rerun import Moment, Rerun
from wasp_cli.methods.base import Heldout
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.metrics.windows import sums_ahead
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Memory

Progress = Callable[[float, str], None]


class Branch(NamedTuple):
    """One branch, of w <= W decision steps: fewer where its episode ended."""

    episode: int
    t: int  # the decision at which it begins
    name: str  # ASSISTED or ALONE
    cost: NDArray[np.bool_]  # [w] c_t
    cost_env: NDArray[np.int64]  # [w] env steps with cost
    reward: NDArray[np.float64]  # [w]


class _Start(NamedTuple):
    """The state in which a decision of one episode was made, and the two actions."""

    t: int
    world: dict[str, NDArray[Any]]  # arrays without the dimension of the batch
    operator: Memory
    h: Tensor
    z: Tensor
    first: dict[str, Tensor]  # [A] by branch


def sampled(intervened: Sequence[NDArray[np.bool_]], stride: int) -> list[list[int]]:
    """Choose every `stride`-th intervened decision of a cell, counted on from episode to episode,
    so that each is as likely as any other.

    Args:
        intervened: per episode [T_e].
        stride: 1 takes all.

    Returns:
        Per episode, decisions in ascending order.
    """
    chosen: list[list[int]] = []
    seen = 0
    for steps in intervened:
        decisions = np.flatnonzero(steps)
        chosen.append(decisions[-seen % stride :: stride].tolist())
        seen += len(decisions)
    return chosen


def least_gain(heldout: Heldout, window: int, fraction: float) -> float:
    """Return tau_R of Eq. 21: a share of the unimpaired expert's mean return in W decision
    steps; NaN where no episode has as many.
    """
    earned = sums_ahead(heldout.reward.numpy(), heldout.episode.numpy(), window)
    earned = earned[~np.isnan(earned)]
    return fraction * float(earned.mean()) if len(earned) else float("nan")


@torch.inference_mode()
def branches(
    rerun: Rerun, chosen: Sequence[Sequence[int]], window: int, progress: Progress
) -> list[Branch]:
    """Run both branches at every chosen decision, sorted by episode, decision and name.

    Args:
        rerun: the episodes; its task and operator carry out the branches afterwards.
        chosen: per episode [B], decisions in ascending order.
    """
    batches = max(map(len, chosen), default=0)
    again = 1 + max((decisions[-1] for decisions in chosen if decisions), default=-1)
    steps = again + 2 * window * batches
    starts = _starts(
        rerun, chosen, again, lambda t: progress(t / steps, f"played again {t}/{again}")
    )
    found: list[Branch] = []
    for k in range(batches):
        rows = {e: mine[k] for e, mine in enumerate(starts) if k < len(mine)}
        for name in (ASSISTED, ALONE):
            found += _run(rerun, rows, name, window)
        progress(
            1 - 2 * window * (batches - k - 1) / steps,
            f"branches {k + 1}/{batches} of every episode",
        )
    return sorted(found, key=lambda branch: branch[:3])


def _starts(
    rerun: Rerun, chosen: Sequence[Sequence[int]], again: int, progress: Callable[[int], None]
) -> list[list[_Start]]:
    """By episode, the state at every chosen decision; `again` decisions are played again."""
    at: dict[int, list[int]] = {}
    for e, decisions in enumerate(chosen):
        for t in decisions:
            at.setdefault(t, []).append(e)
    starts: list[list[_Start]] = [[] for _ in chosen]
    for moment in islice(rerun, again):
        if moment.t in at:
            world, operator = rerun.task.snapshot(), rerun.operator.snapshot()
            for e in at[moment.t]:
                starts[e].append(_start(moment, world, operator, e))
        if moment.t % 25 == 0:
            progress(moment.t + 1)
    return starts


def _start(moment: Moment, world: dict[str, NDArray[Any]], operator: Memory, e: int) -> _Start:
    return _Start(
        moment.t,
        {name: array[e].copy() for name, array in world.items()},
        {name: value[e].clone() for name, value in operator.items()},
        moment.latent.h[e].clone(),
        moment.latent.z[e].clone(),
        {ASSISTED: moment.action[e].clone(), ALONE: moment.a_h[e].clone()},
    )


def _run(rerun: Rerun, rows: dict[int, _Start], name: str, window: int) -> Iterator[Branch]:
    """The branches of one name from the starts of some rows; the other rows are over."""
    task, operator = rerun.task, rerun.operator
    other = next(iter(rows.values()))  # what stands in rows without a start only has to be valid
    starts = [rows.get(e, other) for e in range(task.batch)]
    world = {field: np.stack([start.world[field] for start in starts]) for field in other.world}
    absent = [e not in rows for e in range(task.batch)]
    world["ended"][absent] = True
    task.restore(world)
    operator.restore(
        {
            field: torch.stack([start.operator[field] for start in starts])
            for field in other.operator
        }
    )
    rerun.filter.latent = Latent(
        torch.stack([start.h for start in starts]), torch.stack([start.z for start in starts])
    )
    action = torch.stack([start.first[name] for start in starts])
    going, on = np.zeros(task.batch), torch.zeros(task.batch)
    steps = []
    ended = world["ended"].astype(bool)
    for w in range(window):
        rerun.filter.executed(action)
        operator.observe(action)
        step = task.step(action.numpy())
        steps.append(step)
        going += ~ended
        ended = step.ended.copy()
        if ended.all() or w + 1 == window:
            break
        features = rerun.filter.see(step.observation, on).features
        action = operator.command(features, privileged_view(operator, step.observation)).clamp(
            -1, 1
        )
    parts = [
        np.stack([getattr(step, field) for step in steps])
        for field in ("cost", "cost_env", "reward")
    ]
    for e, start in rows.items():
        cost, cost_env, reward = (part[: int(going[e]), e] for part in parts)
        yield Branch(e, start.t, name, cost.astype(bool), cost_env, reward)
