"""Counterfactual branches of the real task (section 5.3 of the paper): what would have happened
without an intervention.

At a chosen decision of a stored episode two branches begin in the same state: `asst` executes the
recorded action, `cf` the operator's command; afterwards both follow the operator alone. Their draws
are those of the episode and the decision (common random numbers). Every branch runs in the row that
its episode had, in a batch of the same size, so that a branch which does what the episode did gives
the same bits. B episodes, A components of an action, W decisions of a branch at most.
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
from wasp_cli.tasks.base import Step

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
    """Choose every `stride`-th intervened decision of a cell. The count goes on from episode to
    episode, so that all are equally likely.

    Args:
        intervened: by episode [T_e], whether each decision was intervened in.
        stride: 1 takes all.

    Returns:
        By episode, decisions in ascending order.
    """
    chosen: list[list[int]] = []
    seen = 0
    for steps in intervened:
        decisions = np.flatnonzero(steps)
        chosen.append(decisions[-seen % stride :: stride].tolist())
        seen += len(decisions)
    return chosen


def least_gain(heldout: Heldout, window: int, fraction: float) -> float:
    """Return tau_R of Eq. 21: a share of the mean return of the unimpaired expert in W decisions;
    NaN where no episode has as many.
    """
    returns = sums_ahead(heldout.reward.numpy(), heldout.episode.numpy(), window)
    whole = returns[~np.isnan(returns)]
    return fraction * float(whole.mean()) if len(whole) else float("nan")


@torch.inference_mode()
def branches(
    rerun: Rerun, chosen: Sequence[Sequence[int]], window: int, progress: Progress
) -> list[Branch]:
    """Run both branches at every chosen decision, sorted by episode, decision and name.

    Args:
        rerun: the episodes; its task and operator carry out the branches afterwards.
        chosen: [B] by episode, decisions in ascending order.
        window: W.
        progress: called with the share that is done and a text.
    """
    # -- play the episodes again up to the last chosen decision, and keep the states on the way
    rounds = max(map(len, chosen), default=0)
    last = max((decisions[-1] for decisions in chosen if decisions), default=-1)
    replayed = last + 1
    total = replayed + 2 * window * rounds  # decisions in all

    def replaying(t: int) -> None:
        progress(t / total, f"played again {t}/{replayed}")

    starts = _starts(rerun, chosen, replayed, replaying)

    # -- the k-th decisions of all episodes side by side
    found: list[Branch] = []
    for k in range(rounds):
        rows = {e: of_episode[k] for e, of_episode in enumerate(starts) if k < len(of_episode)}
        for name in (ASSISTED, ALONE):
            found += _run(rerun, rows, name, window)
        left = 2 * window * (rounds - k - 1)
        progress(1 - left / total, f"branches {k + 1}/{rounds} of every episode")
    return sorted(found, key=lambda branch: (branch.episode, branch.t, branch.name))


def _starts(
    rerun: Rerun, chosen: Sequence[Sequence[int]], replayed: int, progress: Callable[[int], None]
) -> list[list[_Start]]:
    """Play `replayed` decisions again, and return by episode the state at every chosen one."""
    episodes_at: dict[int, list[int]] = {}
    for e, decisions in enumerate(chosen):
        for t in decisions:
            episodes_at.setdefault(t, []).append(e)
    starts: list[list[_Start]] = [[] for _ in chosen]
    for moment in islice(rerun, replayed):
        if moment.t in episodes_at:
            world = rerun.task.snapshot()
            operator = rerun.operator.snapshot()
            for e in episodes_at[moment.t]:
                starts[e].append(_start(moment, world, operator, e))
        if moment.t % 25 == 0:
            progress(moment.t + 1)
    return starts


def _start(moment: Moment, world: dict[str, NDArray[Any]], operator: Memory, e: int) -> _Start:
    """Copy the state of episode e."""
    return _Start(
        t=moment.t,
        world={name: array[e].copy() for name, array in world.items()},
        operator={name: value[e].clone() for name, value in operator.items()},
        h=moment.latent.h[e].clone(),
        z=moment.latent.z[e].clone(),
        first={ASSISTED: moment.action[e].clone(), ALONE: moment.a_h[e].clone()},
    )


def _run(rerun: Rerun, rows: dict[int, _Start], branch: str, window: int) -> Iterator[Branch]:
    """Yield the branches of one name from the starts of some rows; the other rows count as over."""
    # -- go back to the starts; a row without one holds the state of another, which is valid
    task = rerun.task
    operator = rerun.operator
    other = next(iter(rows.values()))
    starts = [rows.get(e, other) for e in range(task.batch)]
    world = {name: np.stack([start.world[name] for start in starts]) for name in other.world}
    absent = [e not in rows for e in range(task.batch)]
    world["ended"][absent] = True
    task.restore(world)
    memory = {
        name: torch.stack([start.operator[name] for start in starts]) for name in other.operator
    }
    operator.restore(memory)
    h = torch.stack([start.h for start in starts])
    z = torch.stack([start.z for start in starts])
    rerun.filter.latent = Latent(h, z)

    # -- the first action, then the commands of the operator
    action = torch.stack([start.first[branch] for start in starts])
    not_first = torch.zeros(task.batch)
    lengths = np.zeros(task.batch)
    steps: list[Step] = []
    ended = world["ended"].astype(bool)
    for w in range(window):
        rerun.filter.executed(action)
        operator.observe(action)
        step = task.step(action.numpy())
        steps.append(step)
        lengths += ~ended
        ended = step.ended.copy()
        if ended.all() or w + 1 == window:
            break
        latent = rerun.filter.see(step.observation, not_first)
        privileged = privileged_view(operator, step.observation)
        action = operator.command(latent.features, privileged).clamp(-1, 1)

    # -- each row up to the end of its episode
    cost = np.stack([step.cost for step in steps])
    cost_env = np.stack([step.cost_env for step in steps])
    reward = np.stack([step.reward for step in steps])
    for e, start in rows.items():
        length = int(lengths[e])
        yield Branch(
            episode=e,
            t=start.t,
            name=branch,
            cost=cost[:length, e].astype(bool),
            cost_env=cost_env[:length, e],
            reward=reward[:length, e],
        )
