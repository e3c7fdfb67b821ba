"""Random layouts by rejection sampling from a legacy numpy stream, draw for draw as the
reference package does it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import Floats

TRIES_PER_THING = 100
TRIES_PER_LAYOUT = 10_000
TRIES_PER_GOAL = 10_000
SEED_LIMIT = 2**32


class Rectangle(NamedTuple):
    """An upright rectangle on the ground; in m."""

    x0: float  # least x
    y0: float
    x1: float  # greatest x
    y1: float


@dataclass(frozen=True)
class Thing:
    """One object to be placed."""

    name: str
    keepout: float  # radius that no other thing's keepout circle may enter, in m
    places: tuple[Rectangle, ...]  # rectangles that have to hold the keepout circle

    @cached_property
    def free(self) -> tuple[Rectangle, ...]:
        """The rectangles within which the centre may lie."""
        k = self.keepout
        return tuple(
            Rectangle(place.x0 + k, place.y0 + k, place.x1 - k, place.y1 - k)
            for place in self.places
        )

    @cached_property
    def shares(self) -> Floats:
        """Cumulative probabilities of the rectangles, by area."""
        areas = [(place.x1 - place.x0) * (place.y1 - place.y0) for place in self.free]
        cumulative = (np.array(areas) / np.sum(areas)).cumsum()
        shares: Floats = cumulative / cumulative[-1]
        return shares


def square(half_side: float) -> tuple[Rectangle]:
    """Return the square around the origin; lengths in m."""
    return (Rectangle(-half_side, -half_side, half_side, half_side),)


@dataclass(frozen=True)
class Layout:
    """Where an episode starts. Positions in m, angles in rad, world frame."""

    agent_xy: Floats
    agent_yaw: float
    goal_xy: Floats
    others_xy: Floats  # [K, 2] of the remaining things, in order
    others_yaw: Floats  # [K]


def checked_seed(seed: int) -> int:
    """Return the seed itself. Raises TaskError where it is not in [0, 2^32)."""
    if not 0 <= int(seed) < SEED_LIMIT:
        raise TaskError(
            f"seed {seed} is out of range", f"a seed is an integer from 0 to {SEED_LIMIT - 1}"
        )
    return int(seed)


def random_stream(seed: int) -> np.random.RandomState:
    """Return the stream of one episode: numpy's legacy generator, on which the reference
    package's layouts are defined.
    """
    return np.random.RandomState(checked_seed(seed))


def draw_layout(
    stream: np.random.RandomState,
    agent: Thing,
    goal: Thing,
    others: tuple[Thing, ...],
    *,
    goal_again: bool = True,
) -> Layout:
    """Draw agent, goal and others apart from each other, then their yaws, then the goal once
    more (unless `goal_again` is false).

    Raises:
        TaskError: no layout was found in which everything is apart.
    """
    things = (agent, goal, *others)
    # Places [2 + K, 2] of all things.
    for _ in range(TRIES_PER_LAYOUT):
        places = _try_layout(stream, things)
        if places is not None:
            break
    else:
        raise TaskError("no layout found: the things do not fit into their places")
    # Yaws, in the same order.
    yaws = [float(stream.uniform(0.0, 2.0 * np.pi)) for _ in things]
    goal_xy: Floats | None = places[1]
    # The goal once more: the reference package draws it again when the episode begins.
    if goal_again:
        rest_xy = np.concatenate([places[:1], places[2:]])
        goal_xy = draw_goal(stream, goal, (agent, *others), rest_xy)
    if goal_xy is None:
        raise TaskError("no layout found: there is no free place for the goal")
    return Layout(places[0], yaws[0], goal_xy, places[2:], np.array(yaws[2:]))


def draw_goal(
    stream: np.random.RandomState, goal: Thing, others: tuple[Thing, ...], others_xy: Floats
) -> Floats | None:
    """Draw a free place [2] in m for the goal among the others [K, 2], or None when none was
    found.
    """
    limits = np.array([thing.keepout + goal.keepout for thing in others])
    for _ in range(TRIES_PER_GOAL):
        place = _draw(stream, goal)
        if _free(place, others_xy, limits):
            return place
    return None


def _try_layout(stream: np.random.RandomState, things: tuple[Thing, ...]) -> Floats | None:
    """Places [n, 2] of the things, drawn one after the other; None where one found none."""
    places = np.empty((len(things), 2))
    keepouts = np.array([thing.keepout for thing in things])
    for index, thing in enumerate(things):
        limits = keepouts[:index] + thing.keepout
        for _ in range(TRIES_PER_THING):
            place = _draw(stream, thing)
            if _free(place, places[:index], limits):
                places[index] = place
                break
        else:
            return None
    return places


def _draw(stream: np.random.RandomState, thing: Thing) -> Floats:
    """A place [2] for the centre of a thing, whatever else is there."""
    rectangle = thing.free[0]
    if len(thing.free) > 1:
        # As RandomState.choice does it, which takes one uniform number.
        number = stream.random_sample()
        rectangle = thing.free[int(thing.shares.searchsorted(number, side="right"))]
    x = stream.uniform(rectangle.x0, rectangle.x1)
    y = stream.uniform(rectangle.y0, rectangle.y1)
    return np.array([x, y])


def _free(place: Floats, others_xy: Floats, limits: Floats) -> bool:
    """Whether a place [2] is at least `limits` [K] away from the others [K, 2]; in m."""
    offset = others_xy - place
    offset *= offset
    return bool((np.sqrt(offset[:, 0] + offset[:, 1]) >= limits).all())


class Streams:
    """The random streams of B episodes.

    In the reference package every env step draws one uniform double. Here these draws are counted,
    and made up for only when a goal is drawn: the stream is the same, and it is much faster.
    """

    def __init__(self, batch: int) -> None:
        self._streams = [random_stream(0) for _ in range(batch)]
        self._owed = np.zeros(batch, np.int64)

    def start(self, row: int, seed: int) -> np.random.RandomState:
        """Seed a row's stream anew and return it."""
        self._streams[row] = random_stream(seed)
        self._owed[row] = 0
        return self._streams[row]

    def count_step(self, rows: NDArray[np.intp]) -> None:
        """Count the draw of one env step of these rows [n]."""
        self._owed[rows] += 1

    def catch_up(self, row: int) -> np.random.RandomState:
        """Return a row's stream, after the draws of its env steps are made."""
        stream = self._streams[row]
        stream.random_sample(int(self._owed[row]))
        self._owed[row] = 0
        return stream

    def snapshot(self) -> dict[str, NDArray[np.uint32] | NDArray[np.int64]]:
        """Return plain arrays: `stream_key` [B, 624], `stream_position` [B], `stream_owed` [B]."""
        states = [stream.get_state(legacy=False)["state"] for stream in self._streams]
        return {
            "stream_key": np.stack([np.asarray(state["key"], np.uint32) for state in states]),
            "stream_position": np.array([state["pos"] for state in states], np.int64),
            "stream_owed": self._owed.copy(),
        }

    def restore(
        self, key: NDArray[np.uint32], position: NDArray[np.int64], owed: NDArray[np.int64]
    ) -> None:
        """Return to a snapshot: `key` [B, 624], `position` [B], `owed` [B]. The streams draw
        uniform numbers alone, so that there is no cached Gaussian to restore.
        """
        for stream, row_key, row_position in zip(self._streams, key, position, strict=True):
            stream.set_state(("MT19937", row_key, int(row_position), 0, 0.0))
        self._owed = owed.copy()
