"""A scripted driver, which presses keys as a page would, through the real socket: for trials of a
study, and to find out whether this machine is fast enough.

`wasp drive --check` drives a whole episode of each block, and every session begins with a few
decisions of each. Decisions at which a gate fires take longer, since they search for a correction:
they are judged separately too.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from rich.table import Table
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from wasp_cli import seeds
from wasp_cli.console import count_table
from wasp_cli.drive.block import ALONE, Driven
from wasp_cli.drive.desk import END, KEYS, Desk
from wasp_cli.drive.server import LONGEST, Server, unpacked
from wasp_cli.drive.session import Session
from wasp_cli.errors import WaspError
from wasp_cli.plan.node import Cell, Node
from wasp_cli.store.artifact import exists
from wasp_cli.store.people import percentiles
from wasp_cli.tasks.frames import wrapped

# angles to the goal in rad: below the first it drives forward, above the second it turns
AHEAD = 1.0
ASIDE = 0.25
# bytes of what the server sends at most: the picture of the ground is the largest
LARGEST = 4_000_000

# times that it tries to connect, and seconds between them. A page tries for ever.
ATTEMPTS = 20
PAUSE = 0.5

ARROWS = [key for key in KEYS if key.startswith("Arrow")]
HELD = 8
"""Decisions for which each arrow is held if the frame has no map."""

# from the header of a frame to the keys that are held
Driver = Callable[[Mapping[str, Any]], list[str]]


def to_the_goal(header: Mapping[str, Any]) -> list[str]:
    """Return the keys that turn and drive towards the nearest goal. Without a goal they drive
    forward; if the frame has no map, each arrow is held for HELD decisions in turn.
    """
    goals = header.get("things", {}).get("goal")
    robot = header.get("robot")
    if robot is None:
        return [ARROWS[header["t"] // HELD % len(ARROWS)]]
    if not goals:
        return ["ArrowUp"]
    x, y, yaw = robot
    goal = min(goals, key=lambda place: math.hypot(place[0] - x, place[1] - y))
    error = float(wrapped(math.atan2(goal[1] - y, goal[0] - x) - yaw))
    keys = []
    if abs(error) < AHEAD:
        keys.append("ArrowUp")
    if abs(error) > ASIDE:
        keys.append("ArrowLeft" if error > 0 else "ArrowRight")
    return keys


class Habits:
    """A scripted participant: drives to the goal, with a delay and slips of its own, and draws its
    answers.

    The habits are drawn from the participant's number. Two trials still differ a little, since the
    clock does.
    """

    DELAY = 5
    SLIPS = 0.08
    HELD = 5
    """The largest delay in frames, the largest share of frames in which a key slips, and the frames
    for which a wrong key is held.
    """

    def __init__(self, participant: int) -> None:
        self._draw = np.random.default_rng(seeds.derive("drive-script", participant))
        self._seen: deque[list[str]] = deque(maxlen=1 + int(self._draw.integers(self.DELAY)))
        self._slips = float(self._draw.uniform(0.0, self.SLIPS))
        self._wrong: list[str] = []

    def keys(self, header: Mapping[str, Any]) -> list[str]:
        """Return the keys that are held at a frame: those towards the goal of some frames ago, or a
        wrong one.
        """
        self._seen.append(to_the_goal(header))
        if not self._wrong and self._draw.random() < self._slips:
            self._wrong = [str(self._draw.choice(ARROWS))] * self.HELD
        if self._wrong:
            return [self._wrong.pop()]
        return self._seen[0]

    def answers(self, form: Mapping[str, Any]) -> dict[str, Any]:
        """Fill in a form: agree to a consent, and draw a whole number from 0 to 100 for each
        scale.
        """
        scales = {scale["name"]: float(self._draw.integers(0, 101)) for scale in form["scales"]}
        return {"agreed": True if form["name"] == "consent" else None, "scales": scales}


async def drive(
    address: str,
    driver: Driver = to_the_goal,
    answers: Callable[[Mapping[str, Any]], dict[str, Any]] | None = None,
) -> int:
    """Drive a whole session through the page's socket, from the first frame to the end.

    Args:
        address: of the page, with its token.
        driver: returns the keys to hold, from the header of a frame.
        answers: fills in a form; only studies have forms.

    Returns:
        How many frames were seen.

    Raises:
        WaspError: there is no connection, or it was lost.
    """
    frames = 0
    held = [""]
    number = 0
    async with await connected(address) as ws:

        async def send(message: Mapping[str, Any]) -> None:
            text = json.dumps(message)
            assert len(text) <= LONGEST
            await ws.send(text)

        async def alive() -> None:
            while True:
                await asyncio.sleep(1.0)
                await send({"type": "alive"})

        beating = asyncio.create_task(alive())
        try:
            async for message in ws:
                if isinstance(message, bytes):
                    header, _ = unpacked(message)
                    frames += 1
                    await send({"type": "ack", "frame": header["frame"]})
                    keys = driver(header)
                    if keys != held:
                        held = keys
                        number = number + 1
                        await send(
                            {"type": "input", "number": number, "keys": keys, "axes": [0.0, 0.0]}
                        )
                    continue
                state = json.loads(message)
                if state.get("type") != "state":
                    continue
                if state["phase"] in ("ready", "paused"):
                    held = [""]
                    await send({"type": "ask", "what": "go"})
                elif state["phase"] == "form" and answers is not None:
                    await send({"type": "answers", **answers(state["form"])})
                elif state["phase"] == "over":
                    return frames
        except ConnectionClosed as error:
            hint = "the machine may be too busy: try again with --speed 0.5"
            raise WaspError(
                f"the scripted driver lost its connection after {frames} frames", hint
            ) from error
        finally:
            beating.cancel()
    return frames


async def connected(address: str) -> ClientConnection:
    """Connect to the page's socket; up to ATTEMPTS times, PAUSE seconds apart. Raises WaspError if
    that fails.
    """
    parts = urlsplit(address)
    attempts = 0
    while True:
        try:
            return await connect(
                f"ws://{parts.netloc}/socket?{parts.query}",
                max_size=LARGEST,
                ping_interval=None,
                compression=None,
            )
        except (OSError, InvalidHandshake) as error:  # TimeoutError is an OSError
            attempts += 1
            if attempts == ATTEMPTS:
                raise WaspError(
                    f"the scripted driver cannot connect: {error}",
                    "the machine may be too busy: try again",
                ) from error
        await asyncio.sleep(PAUSE)


TOLERATED = 0.02  # share of decisions that may be late
TOLERATED_FIRED = 0.1  # the same among decisions at which a gate fires: so their 90th percentile
TOLERATED_PACE = 1.05  # wall time of a decision in periods: by how much the world may slow down
BRIEF = 30  # decisions with which a session begins
SPEEDS = (1.0, 0.9, 0.8, 0.75, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25, 0.2, 0.1)


@dataclass(frozen=True)
class Timing:
    """How an episode that the scripted driver drove was paced. Times are in ms, shares in [0,
    1].
    """

    label: str
    period_ms: float
    decisions: int
    late_share: float
    decision_ms: tuple[float, float]  # median and 99th percentile of the answers, late ones too
    # from the arrival of a key to the execution of what it commands; of decisions whose command was
    # new
    input_ms: tuple[float, float]
    round_trip_ms: tuple[float, float]
    speed: float
    recommended: float
    pace: float  # wall time of a decision in periods
    fired: int  # answers with which a gate fired, late ones too
    fired_late_share: float  # of these; 0 where there are none
    fired_ms: tuple[float, float]  # their median and 90th percentile

    @property
    def in_time(self) -> bool:
        """Whether late decisions and the slowing down of the world are tolerable."""
        return (
            self.late_share <= TOLERATED
            and self.fired_late_share <= TOLERATED_FIRED
            and self.pace <= TOLERATED_PACE
        )

    @property
    def where_gates_fired(self) -> str:
        """A sentence about the decisions at which a gate fired, which need a search."""
        if not self.fired:
            return f"{self.label}: no gate fired"
        median, most = self.fired_ms
        times = f"{median:.0f} ms (median), {most:.0f} ms (90th percentile)"
        return (
            f"{self.label}: a gate fired at {self.fired} decisions: {times}, "
            f"{self.fired_late_share:.0%} late"
        )


def warning(session: Session) -> str | None:
    """Drive the first decisions of every condition that is still to come, and return a warning if
    they are not in time; None if they are.
    """
    ahead = {
        (cell.task, cell.method, cell.variant): (cell, node)
        for cell, node in session.blocks
        if cell.method != ALONE and not exists(session.layout, node.kind, node.key)
    }
    slow = [
        timing
        for timing in checked_blocks(replace(session, blocks=[*ahead.values()]), BRIEF)
        if not timing.in_time
    ]
    if not slow:
        return None
    shares = ", ".join(
        f"{timing.label} {timing.late_share:.0%}, the world {timing.pace:.1f} times slower"
        for timing in slow
    )
    speed = min(timing.recommended for timing in slow)
    return (
        f"this machine is busy or slow, and the assistant may be late (late: {shares}); "
        f"--speed {speed:g} would keep it in time"
    )


def checked_blocks(session: Session, most: int | None = None) -> list[Timing]:
    """Let the scripted driver drive an episode of each block, or its first `most` decisions.
    Nothing is recorded.
    """
    # The driver finds its way by the numbers of the map.
    session = replace(session, how=replace(session.how, shown=session.how.shown | {"map"}))
    timings = []
    for cell, node in session.blocks:
        desk = Desk()
        server = Server(desk)
        server.start()
        with ThreadPoolExecutor(1) as clock:
            driving = clock.submit(_unrecorded, session, cell, node, most, desk)
            try:
                asyncio.run(drive(server.address))
            finally:
                desk.ask(END)
                server.stop()
            timings.append(driving.result())
    return timings


def _unrecorded(session: Session, cell: Cell, node: Node, most: int | None, desk: Desk) -> Timing:
    try:
        block = session.built(desk, cell, node, node.axes["method_config"])
        try:
            driven = block.episode(0, seeds.derive("drive-check", cell.task), 0, {"of": 1}, most)
        finally:
            block.close()
    finally:
        desk.state("over", text="", blocks=[])
    assert isinstance(driven, Driven)
    beats = driven.beats
    speed = session.how.speed
    # Times of all answers, and of those with which a gate fired.
    seconds = [duration for duration, _, _ in block.answers]
    fired = [duration for duration, _, has_fired in block.answers if has_fired]
    fired_late = [late for _, late, has_fired in block.answers if has_fired]
    fired_late_share = 0.0
    fired_ms = (math.nan, math.nan)
    if fired:
        fired_late_share = float(np.mean(fired_late))
        fired_ms = (
            1000 * float(np.median(fired)),
            1000 * float(np.quantile(fired, 1 - TOLERATED_FIRED)),
        )
    # From the arrival of a new key to its action, and from each decision to the next.
    new_inputs = [
        after.input_age_ms for before, after in pairwise(beats) if after.input != before.input
    ]
    between = [after.at - before.at for before, after in pairwise(beats)] or [block.period]
    return Timing(
        label=node.label,
        period_ms=1000 * block.period,
        decisions=len(beats),
        late_share=float(np.mean([beat.late for beat in beats])),
        decision_ms=percentiles([1000 * duration for duration in seconds]),
        input_ms=percentiles(new_inputs),
        round_trip_ms=percentiles([beat.round_trip_ms for beat in beats]),
        speed=speed,
        recommended=recommended(seconds, fired, driven, block.period, speed, between),
        pace=float(np.mean(between)) / block.period,
        fired=len(fired),
        fired_late_share=fired_late_share,
        fired_ms=fired_ms,
    )


def recommended(
    seconds: list[float],
    fired: list[float],
    driven: Driven,
    period: float,
    speed: float,
    between: Sequence[float],
) -> float:
    """Return the largest of SPEEDS at which these answers would have been in time, except for a
    tolerated share, and the world as well.

    Args:
        seconds: of all answers.
        fired: of the answers with which a gate fired.
        driven: the episode. The time for everything but deciding (its `rest_ms`) is kept free.
        period: of a decision, in seconds.
        speed: at which it was driven.
        between: seconds from each decision to the next.
    """
    # The period that is needed: for an answer, and for everything else.
    answers = [0.0]
    if seconds:
        answers.append(float(np.quantile(seconds, 1 - TOLERATED)))
    if fired:
        answers.append(float(np.quantile(fired, 1 - TOLERATED_FIRED)))
    rest = float(np.median([beat.rest_ms for beat in driven.beats])) / 1000
    needed = max(answers) + rest
    has_slowed = np.mean(between) > TOLERATED_PACE * period

    # The fastest speed whose period is long enough.
    for candidate in SPEEDS:
        longer = period * speed / candidate
        if longer < needed:
            continue
        if has_slowed and np.mean(np.maximum(between, longer)) > TOLERATED_PACE * longer:
            continue
        return candidate
    return SPEEDS[-1]


def timing_table(timings: Sequence[Timing]) -> Table:
    """Return the figures of a check as a table, with rows below each cell's label, so that it fits
    into 80 columns.
    """
    table = count_table("", "median", "99th percentile")
    for timing in timings:
        table.add_row(timing.label, style="bold")
        pairs = {
            "decision": timing.decision_ms,
            "key to action": timing.input_ms,
            "round trip": timing.round_trip_ms,
        }
        for name, pair in pairs.items():
            table.add_row(f"  {name}", *(f"{value:.1f} ms" for value in pair))
        table.add_row(f"  {timing.late_share:.1%} of {timing.decisions} decisions late")
        table.add_row(
            f"  period {timing.period_ms:.0f} ms; in time at --speed {timing.recommended:g}"
        )
    return table


def as_json(timing: Timing) -> dict[str, Any]:
    """Return the numbers of a check as JSON values; None is undefined."""

    def known(value: float) -> float | None:
        return round(value, 2) if math.isfinite(value) else None

    pairs = {
        "decision": timing.decision_ms,
        "key_to_action": timing.input_ms,
        "round_trip": timing.round_trip_ms,
    }
    numbers = {
        f"{name}_p{share}_ms": known(value)
        for name, pair in pairs.items()
        for share, value in zip((50, 99), pair, strict=True)
    }
    numbers |= {"pace": known(timing.pace), "fired_late_share": round(timing.fired_late_share, 4)}
    numbers |= {
        f"fired_p{share}_ms": known(value)
        for share, value in zip((50, 90), timing.fired_ms, strict=True)
    }
    return {
        "label": timing.label,
        "period_ms": timing.period_ms,
        "decisions": timing.decisions,
        "late_share": round(timing.late_share, 4),
        **numbers,
        "fired": timing.fired,
        "speed": timing.speed,
        "recommended": timing.recommended,
    }
