"""Recorded actions carried out on a task again, by the physics alone. T_e = decisions of
episode e, B = episodes, A = action size.
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
    """B episodes before decision t; after the last one when t is T, the decisions of the
    longest. Rows that are over mean nothing.
    """

    t: int
    observation: Observation
    action: Floats32  # [B, A] what is executed next; zero in rows whose episodes are over
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
    """Carry recorded actions out again: T + 1 moments, each before its action is carried out.

    Args:
        task: of B rows.
        layouts: [B] seeds of the worlds.
        actions: [T_e, A] per episode, what was executed.
        rewards: [T_e] per episode, what it was rewarded with.
        tolerance: by how much a reward may differ, absolute and relative; 0: not at all.
    """
    lengths = np.array([len(episode) for episode in actions])
    executed, recorded = side_by_side(actions), side_by_side(rewards)
    observation, step = task.reset(list(layouts)), None
    nothing = np.zeros(executed.shape[1:], np.float32)
    for t in range(len(executed)):
        alive = t < lengths
        yield Played(t, observation, executed[t], alive, step)
        step = task.step(executed[t])
        observation = step.observation
        require_same(
            t,
            alive,
            "the reward is",
            step.reward.astype(np.float32),
            recorded[t],
            tolerance,
            number,
        )
        for e in np.flatnonzero(alive & (step.ended != (t + 1 == lengths))):
            raise other_episode(
                number + int(e),
                len(lengths),
                t,
                f"the episode {'ends' if step.ended[e] else 'goes on'} here",
            )
    yield Played(len(executed), observation, nothing, len(executed) < lengths, step)


def require_same(
    t: int,
    alive: NDArray[np.bool_],
    what: str,
    found: Floats32,
    recorded: Floats32,
    tolerance: float = 0.0,
    number: int = 0,
) -> None:
    """Refuse values [B, ...] that are not the recorded ones in rows whose episodes are still
    going; the first row has this number.
    """
    same = np.isclose(found, recorded, tolerance, tolerance).reshape(len(alive), -1).all(1)
    wrong = np.flatnonzero(alive & ~same)
    if wrong.size:
        e = int(wrong[0])
        raise other_episode(
            number + e,
            len(alive),
            t,
            f"{what} {found[e].tolist()} here, and {recorded[e].tolist()} was recorded",
        )


def side_by_side(episodes: Sequence[Array]) -> Floats32:
    """Stack values [T_e, ...] per episode as [T, B, ...], zero after the ends; T is that of the
    longest.
    """
    longest = max(map(len, episodes))
    padded = np.zeros((longest, len(episodes), *np.shape(episodes[0])[1:]), np.float32)
    for e, values in enumerate(episodes):
        padded[: len(values), e] = values
    return padded


def other_episode(episode: int, episodes: int, t: int, what: str) -> ArtifactError:
    """Build the error that an episode, one of so many, is not the recorded one from decision
    `t` on.
    """
    which = f"episode {episode}" if episodes > 1 or episode else "the episode"
    return ArtifactError(
        f"the same actions lead elsewhere: {which} is not the recorded one from decision "
        f"{t} on: {what}",
        "it was computed by other code, other libraries or on another sort of machine: "
        "show it there, or run it again here",
    )
