"""The contract of a task: a batch of B constrained Markov decision processes, advanced one decision
step at a time.

A decision step is `action_repeat` env steps under one action. B = episodes side by side, A = action
size, S = size of the state vector, P = size of the privileged vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

# side of each camera image in pixels; an observation stacks two RGB images to 6 channels
CAMERA_SIZE = 64
MAP_SIZE = 256  # side of a map for people in pixels, where nothing else is asked for


class Observation(NamedTuple):
    """What a batch of tasks shows after a decision step. A field that was not asked for is None."""

    pixels: Pixels | None  # uint8 [B, 6, 64, 64]: front RGB, then rear RGB, channels first
    # float64 [B, S]: the vector observation of the reference package, in its order
    state: Floats | None
    privileged: NDArray[np.float32] | None
    """float32 [B, P]: what an expert may know (no sensor horizon); never given to an assistant."""


class Step(NamedTuple):
    """The outcome of one decision step. Rows of episodes that had ended before are zero and
    repeat the last observation.
    """

    observation: Observation
    reward: Floats  # [B] sum over the env steps of the repeat
    cost: Bools  # [B] c_t = 1[any cost in the repeat]
    cost_env: NDArray[np.int64]  # [B] number of env steps of the repeat that cost
    # per cost source: [B] number of env steps of the repeat in which it cost
    sources: dict[str, NDArray[np.int64]]
    goals: NDArray[np.int64]  # [B] goals reached within the repeat
    # [B] env steps that were executed (fewer than the repeat when the episode ended within it)
    env_steps: NDArray[np.int64]
    ended: Bools  # [B] the episode is over, now or since an earlier step
    terminated: Bools  # [B] it ended by the task's own rule (not by the time limit)


class VectorTask(Protocol):
    """B episodes of one task. A finished episode stays finished until it is reset: there is no
    autoreset.
    """

    batch: int
    action_size: int
    action_low: Floats  # [A]
    action_high: Floats  # [A]
    privileged_size: int
    state_size: int
    action_repeat: int
    decision_seconds: float  # simulated time of one decision step in seconds
    max_decisions: int  # decision steps after which every episode has ended
    cost_sources: tuple[str, ...]

    def reset(self, seeds: Sequence[int], rows: Bools | None = None) -> Observation:
        """Start new episodes: `seeds` has one seed for each reset row, in order (`rows` [B];
        None: all rows).
        """
        ...

    def step(self, action: NDArray[Any]) -> Step:
        """Advance every unfinished episode by one decision step under `action` [B, A] (clipped to
        the bounds).

        Raises:
            TaskError: the action is not finite or has a wrong shape, or every episode has ended.
        """
        ...

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return everything that determines the future of every row, as plain arrays; `restore` of
        it is bit-exact.

        The first dimension of every array is B, so that rows can be taken from one snapshot and put
        into another (or into one of another batch); `ended` [B] is among them.

        Raises:
            TaskError: no episode was started in one of the rows.
        """
        ...

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> Observation:
        """Return to a snapshot taken from a task of the same class, batch and options."""
        ...
