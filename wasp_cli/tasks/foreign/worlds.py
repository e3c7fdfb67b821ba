"""Whether an episode of a foreign environment depends on its seed and its actions alone.

Assistants are compared in the same worlds, and many episodes run side by side. So an episode must
not depend on the episodes before it, on those beside it, on the process that it runs in, or on
chance.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.foreign.calls import EnvStep, GymEnv, reset, step
from wasp_cli.tasks.foreign.content import content_of
from wasp_cli.tasks.foreign.replayed import Replayed
from wasp_cli.tasks.foreign.views import Views

DRAW = "draw everything from self.np_random, after super().reset(seed=seed)"
AGAIN = "the second time"
FRESH = "in a second instance of the environment"
BESIDE = "beside a second instance that is stepped in turn with it"
_REMEDIES = {
    AGAIN: f"{DRAW}, and clear in reset what an episode leaves behind: assistants are compared in "
    "the same worlds",
    FRESH: "let reset set everything that an episode begins with: instances must not count "
    "episodes or share a random generator",
    BESIDE: "keep everything in `self`, and nothing in the class, in the module, or in a client "
    "or a random generator that instances share: many episodes run side by side",
}


def random_actions(env: GymEnv, count: int, seed: int = 0) -> list[NDArray[Any]]:
    """Return random actions within the bounds of an environment, of its action space's type."""
    space = env.action_space
    assert space.shape is not None
    draws = np.random.default_rng(seed)
    # It is a Box, as `examine` has checked.
    low = space.low  # type: ignore[attr-defined]
    high = space.high  # type: ignore[attr-defined]
    return [draws.uniform(low, high).astype(space.dtype) for _ in range(count)]


class Episode:
    """The beginning of an episode, kept step by step. What an environment shows is copied, since
    it may write the next observation into the same array.
    """

    def __init__(self, env: GymEnv, seed: int, views: Views | None = None) -> None:
        """Begin the episode of a seed; `views` look at every observation."""
        self._env = env
        self._views = views
        self.first = self._kept(reset(env, seed))
        self.steps: list[EnvStep] = []

    @property
    def is_over(self) -> bool:
        """Whether the last step ended it."""
        return bool(self.steps) and (self.steps[-1].terminated or self.steps[-1].truncated)

    def advance(self, action: NDArray[Any]) -> None:
        """Take an env step, unless the episode has ended."""
        if not self.is_over:
            done = step(self._env, action.copy())
            self.steps.append(done._replace(seen=self._kept(done.seen)))

    def through(self, actions: Sequence[NDArray[Any]]) -> Episode:
        """Take a step for every action, and return this episode."""
        for action in actions:
            self.advance(action)
        return self

    def continued(self, actions: Sequence[NDArray[Any]]) -> str:
        """Return the digest of the steps that follow, which this episode does not keep."""
        rest = copy.copy(self)
        rest.steps = []
        return rest.through(actions).digest()

    def _kept(self, seen: Any) -> Any:
        """A copy of an observation, after the views have checked it."""
        if self._views is not None:
            self._views.check(seen)
        return copy.deepcopy(seen)

    def digest(self) -> str:
        """Return a text that is the same for equal episodes."""
        content = hashlib.sha256()
        content.update(content_of(self.first))
        for done in self.steps:
            content.update(content_of(done.seen))
            content.update(repr((done.reward, done.cost, done.terminated, done.truncated)).encode())
        return content.hexdigest()


def difference(one: Episode, other: Episode) -> str | None:
    """Return what differs first between two episodes, in words; None where nothing does."""
    if not same(one.first, other.first):
        return "its first observation differs"
    pairs = zip(one.steps, other.steps, strict=False)
    for number, (left, right) in enumerate(pairs, start=1):
        for name in ("reward", "cost", "terminated", "truncated"):
            first_value = getattr(left, name)
            second_value = getattr(right, name)
            if first_value != second_value:
                return f"the {name} of step {number} is {first_value:g} and {second_value:g}"
        if not same(left.seen, right.seen):
            return f"the observation of step {number} differs"
    return None if len(one.steps) == len(other.steps) else "its length differs"


def require_same(one: Episode, other: Episode, what: str) -> None:
    """Check that two episodes are the same. Raises TaskError.

    Args:
        one: the episode.
        other: the same episode, which should not differ.
        what: `AGAIN`, `FRESH` or `BESIDE`: where the second one took place.
    """
    differs = difference(one, other)
    if differs is not None:
        raise TaskError(
            f"the same seed and actions give another episode {what}: {differs}", _REMEDIES[what]
        )


def require_independent(one: GymEnv, other: GymEnv, steps: int) -> None:
    """Check that an episode is the same in a second instance, and beside one.

    Args:
        one: an instance.
        other: another one, in which no episode has begun yet.
        steps: env steps of each episode.

    Raises:
        TaskError: an episode is another one in a second instance, or beside a second one.
    """
    actions = random_actions(one, steps, seed=1)
    alone = Episode(one, 0).through(actions)
    fresh = Episode(other, 0).through(actions)
    require_same(alone, fresh, FRESH)
    neighbour_alone = Episode(other, 1).through(actions)
    beside = Episode(one, 0)
    neighbour = Episode(other, 1)
    for action in actions:
        beside.advance(action)
        neighbour.advance(action)
    require_same(alone, beside, BESIDE)
    require_same(neighbour_alone, neighbour, BESIDE)


def require_restored(env: GymEnv, steps: int) -> bool:
    """Check that an episode goes on from a restored snapshot as it did. Raises TaskError.

    Returns:
        Whether the environment has snapshots of its own; else the episode is played again.
    """
    snapshot = env.get_wrapper_attr("snapshot")
    restore = env.get_wrapper_attr("restore")
    has_own = not isinstance(env, Replayed)
    actions = random_actions(env, 2 * steps, seed=2)
    episode = Episode(env, 0).through(actions[:steps])
    if episode.is_over:
        return has_own
    snapshot_copy = copy.deepcopy(snapshot())
    first_digest = episode.continued(actions[steps:])
    restore(snapshot_copy)
    second_digest = episode.continued(actions[steps:])
    if first_digest != second_digest:
        raise TaskError(
            "after restore(snapshot()) an episode goes on differently",
            "a snapshot holds everything that decides the future, the random state included",
        )
    return has_own


def same(one: Any, other: Any) -> bool:
    """Return whether two observations are equal, bit for bit."""
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    left: NDArray[Any] = np.asarray(one)
    right: NDArray[Any] = np.asarray(other)
    return left.shape == right.shape and left.tobytes() == right.tobytes()
