"""Recorded actions carried out on a task again, without any model. T_e decisions of episode e, T
those of the longest, B episodes, A components of an action.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import ArtifactError
from wasp_cli.tasks.base import Observation, Step, VectorTask

Array = NDArray[Any]
Floats32 = NDArray[np.float32]


class Played(NamedTuple):
    """B episodes before decision t, or after the last decision when t is T. Rows whose episodes are
    over mean nothing.
    """

    t: int
    observation: Observation
    action: Floats32  # [B, A] the next action; zero in rows whose episodes are over
    alive: NDArray[np.bool_]  # [B] the episode is still going
    last: Step | None  # what decision t - 1 led to


def play(
    task: VectorTask,
    layouts: Sequence[int],
    actions: Sequence[Array],
    rewards: Sequence[Array],
    tolerance: float = 0.0,
    number: int = 0,
) -> Iterator[Played]:
    """Carry recorded actions out again, and compare rewards and ends with the recorded ones.

    Args:
        task: of B rows.
        layouts: [B] seeds of the worlds.
        actions: by episode [T_e, A], executed actions.
        rewards: by episode [T_e], recorded rewards.
        tolerance: by how much a reward may differ, absolute and relative; 0: not at all.
        number: of the first episode, in messages.

    Yields:
        T + 1 moments, each before its action is carried out.

    Raises:
        ArtifactError: a reward or an end differs from the recorded one.
    """
    lengths = np.array([len(episode) for episode in actions])
    executed = side_by_side(actions)
    recorded = side_by_side(rewards)
    observation = task.reset(list(layouts))
    step: Step | None = None
    for t in range(len(executed)):
        # -- before the action
        alive = t < lengths
        yield Played(t, observation, executed[t], alive, step)

        # -- carry it out, and compare
        step = task.step(executed[t])
        observation = step.observation
        reward = step.reward.astype(np.float32)
        require_same(t, alive, "the reward is", reward, recorded[t], tolerance, number)
        differs = alive & (step.ended != (t + 1 == lengths))
        for e in np.flatnonzero(differs):
            verb = "ends" if step.ended[e] else "goes on"
            raise other_episode(number + int(e), len(lengths), t, f"the episode {verb} here")
    no_action = np.zeros(executed.shape[1:], np.float32)
    yield Played(len(executed), observation, no_action, len(executed) < lengths, step)


def require_same(
    t: int,
    alive: NDArray[np.bool_],
    what: str,
    found: Floats32,
    recorded: Floats32,
    tolerance: float = 0.0,
    number: int = 0,
) -> None:
    """Compare values [B, ...] with the recorded ones in the rows whose episodes are still going.

    Args:
        t: the decision.
        alive: [B] the episode is still going.
        what: the beginning of the message, with its verb.
        found: [B, ...] the values.
        recorded: [B, ...] the recorded ones.
        tolerance: by how much a value may differ, absolute and relative; 0: not at all.
        number: of the first row, in messages.

    Raises:
        ArtifactError: a value differs.
    """
    is_close = np.isclose(found, recorded, tolerance, tolerance)
    same = is_close.reshape(len(alive), -1).all(1)
    differing = np.flatnonzero(alive & ~same)
    if differing.size:
        e = int(differing[0])
        raise other_episode(
            number + e,
            len(alive),
            t,
            f"{what} {found[e].tolist()} here, and {recorded[e].tolist()} was recorded",
        )


def side_by_side(episodes: Sequence[Array]) -> Floats32:
    """Stack values of B episodes [T_e, ...] as [T, B, ...], with zeros after the ends."""
    longest = max(map(len, episodes))
    padded = np.zeros((longest, len(episodes), *np.shape(episodes[0])[1:]), np.float32)
    for e, values in enumerate(episodes):
        padded[: len(values), e] = values
    return padded


def other_episode(episode: int, episodes: int, t: int, what: str) -> ArtifactError:
    """Return the error that an episode differs from the recorded one from decision `t` on.

    Args:
        episode: its number.
        episodes: how many are played side by side.
        t: the decision.
        what: how it differs.
    """
    which = f"episode {episode}" if episodes > 1 or episode else "the episode"
    return ArtifactError(
        f"the same actions lead elsewhere: {which} is not the recorded one from decision "
        f"{t} on: {what}",
        "it was computed by other code, other libraries or on another sort of machine: "
        "show it there, or run it again here",
    )
