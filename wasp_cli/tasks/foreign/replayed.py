"""Snapshots of an environment that has none: the seed of the episode and the actions since.

To return to one is to begin the episode again and to take the same actions. That leads to the same
state if an episode depends on its seed and its actions alone; the last observation is compared to
see whether it did.
"""

from __future__ import annotations

import hashlib
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.foreign.calls import GymEnv
from wasp_cli.tasks.foreign.content import content_of

SEED = "seed"
COUNT = "count"
ACTIONS = "actions"
SEEN = "seen"
DIGEST_BYTES = 16


class Replayed(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment with `snapshot()` and `restore(arrays)`.

    An episode is played again when it goes on, not when it is restored: of many rows that are
    restored, those that have ended cost nothing.
    """

    def __init__(self, env: GymEnv, limit: int) -> None:
        """`limit`: env steps of an episode at most; snapshots have room for as many actions."""
        super().__init__(env)
        self._limit = limit
        self._seed: int | None = None
        self._actions: list[NDArray[Any]] = []
        self._seen: Any = None  # the last observation
        self._awaited: bytes | None = None
        """Digest of the observation to which the actions lead, as long as they are not taken."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin an episode, and note its seed."""
        self._seed = seed
        self._actions = []
        self._awaited = None
        returned: Any = self.env.reset(seed=seed)
        self._seen = _first(returned)
        return returned

    def step(self, action: Any) -> Any:
        """Take a step, and note its action; first the restored episode is played again."""
        self._play_again()
        self._actions.append(np.array(action))
        returned = self.env.step(action)
        self._seen = _first(returned)
        return returned

    def render(self) -> Any:
        """Draw the state, of a restored episode after it was played again."""
        self._play_again()
        return self.env.render()

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return arrays whose shapes do not depend on how far the episode is."""
        if self._seed is None:
            raise TaskError("a snapshot of an episode without a seed", "call reset(seed=...) first")
        digest = self._awaited if self._awaited is not None else _digest(self._seen)
        space = self.action_space
        assert space.shape is not None
        actions = np.zeros((max(self._limit, len(self._actions)), *space.shape), space.dtype)
        for number, action in enumerate(self._actions):
            actions[number] = action
        return {
            SEED: np.asarray(self._seed, np.int64),
            COUNT: np.asarray(len(self._actions), np.int64),
            ACTIONS: actions,
            SEEN: np.frombuffer(digest, np.uint8).copy(),
        }

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> None:
        """Return to a snapshot; the episode is played again when it goes on."""
        count = int(snapshot[COUNT])
        self._seed = int(snapshot[SEED])
        self._actions = [np.array(action) for action in snapshot[ACTIONS][:count]]
        self._awaited = snapshot[SEEN].tobytes()

    def _play_again(self) -> None:
        """Play a restored episode up to where it was, if that was not done yet."""
        if self._awaited is None:
            return
        awaited = self._awaited
        self._awaited = None
        returned: Any = self.env.reset(seed=self._seed)
        for action in self._actions:
            returned = self.env.step(action.copy())
        self._seen = _first(returned)
        if _digest(self._seen) != awaited:
            raise TaskError(
                f"seed {self._seed} and the same {len(self._actions)} actions lead to another "
                "observation, so that no earlier step can be returned to",
                "draw everything from self.np_random, after super().reset(seed=seed); or give the "
                "environment snapshot() and restore(arrays)",
            )


def with_snapshots(env: GymEnv, limit: int) -> GymEnv:
    """Return an environment that has `snapshot` and `restore`: its own, or those of `Replayed`."""
    try:
        env.get_wrapper_attr("snapshot")
        env.get_wrapper_attr("restore")
    except AttributeError:
        return Replayed(env, limit)
    return env


def _first(returned: Any) -> Any:
    """The observation in what a reset or a step returned; `calls` checks the rest of it."""
    return returned[0] if isinstance(returned, tuple) and returned else None


def _digest(seen: Any) -> bytes:
    return hashlib.blake2b(content_of(seen), digest_size=DIGEST_BYTES).digest()
