"""What every batch of episodes checks and adds up, whatever its episodes are. B = episodes, A =
action size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import Bools, Floats, Observation, Step
from wasp_cli.tasks.layout import checked_seed


def check_options(batch: int, action_repeat: int, threads: int, observe: Sequence[str]) -> None:
    """Check the arguments of a task. Raises TaskError where a number is below 1, or a name is no
    field of `Observation`.
    """
    if batch < 1 or action_repeat < 1 or threads < 1:
        raise TaskError(
            f"batch {batch}, action_repeat {action_repeat} and threads {threads} must be at least 1"
        )
    unknown = sorted(set(observe) - set(Observation._fields))
    if unknown:
        raise TaskError(
            f"no such observation: {', '.join(unknown)}", f"known: {', '.join(Observation._fields)}"
        )


def chosen_rows(batch: int, seeds: Sequence[int], rows: Bools | None) -> Iterator[tuple[int, int]]:
    """Return the rows (mask [B]; None: all) that start anew, each with its seed.

    Raises:
        TaskError: the mask has another shape, there are not as many seeds as rows, or a seed is out
            of range.
    """
    if rows is not None and np.shape(rows) != (batch,):
        raise TaskError(f"rows has shape {np.shape(rows)}, expected ({batch},)")
    chosen = np.arange(batch) if rows is None else np.flatnonzero(rows)
    if len(seeds) != len(chosen):
        raise TaskError(f"got {len(seeds)} seeds for {len(chosen)} rows")
    return zip(chosen.tolist(), [checked_seed(seed) for seed in seeds], strict=True)


def checked_action(action: NDArray[Any], batch: int, size: int) -> Floats:
    """Return an action [B, A] as float64, clipped to [-1, 1]. Raises TaskError where it has another
    shape, or is not finite.
    """
    control = np.asarray(action, np.float64)
    if control.shape != (batch, size):
        raise TaskError(f"action has shape {control.shape}, expected ({batch}, {size})")
    finite = np.isfinite(control).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise TaskError(f"action of row {row} is not finite: {control[row].tolist()}")
    return np.clip(control, -1.0, 1.0)


def running_rows(ended: Bools) -> NDArray[np.intp]:
    """Return the rows [n] whose episodes have not ended, of `ended` [B]. Raises TaskError where
    there is none.
    """
    rows = np.flatnonzero(~ended)
    if not rows.size:
        raise TaskError("step after the end: no episode of the batch is running; call reset first")
    return rows


def check_begun(begun: Bools) -> None:
    """Check before a snapshot that an episode was started in every row (`begun` [B]). Raises
    TaskError.
    """
    if not begun.all():
        rows = ", ".join(map(str, np.flatnonzero(~begun)))
        raise TaskError(
            f"a snapshot before the first reset: no episode has begun in row {rows}",
            "call reset first",
        )


@dataclass(frozen=True)
class Totals:
    """Sums over one decision step, one entry per row; see `Step`."""

    reward: Floats
    cost: NDArray[np.int64]  # env steps that cost
    goals: NDArray[np.int64]
    env_steps: NDArray[np.int64]
    sources: dict[str, NDArray[np.int64]]

    @classmethod
    def zeros(cls, batch: int, sources: Sequence[str]) -> Totals:
        """Begin a decision step of B episodes: every sum [B] is zero."""
        counts = np.zeros((3 + len(sources), batch), np.int64)
        return cls(
            reward=np.zeros(batch),
            cost=counts[0],
            goals=counts[1],
            env_steps=counts[2],
            sources=dict(zip(sources, counts[3:], strict=True)),
        )

    def as_step(self, observation: Observation, ended: Bools, terminated: Bools) -> Step:
        """Return the outcome of the decision step; `ended` and `terminated` are [B]."""
        return Step(
            observation=observation,
            reward=self.reward,
            cost=self.cost > 0,
            cost_env=self.cost,
            sources=self.sources,
            goals=self.goals,
            env_steps=self.env_steps,
            ended=ended.copy(),
            terminated=terminated.copy(),
        )
