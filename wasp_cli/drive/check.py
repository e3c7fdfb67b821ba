"""Is this machine fast enough? An unrecorded episode by a scripted driver, through the real socket.

`wasp drive --check` drives a whole one, and every session begins with the first decisions of one. Hazards make a gate fire and start the
search, so that the decisions at which a gate fires are judged by themselves too.
"""

from __future__ import annotations

import asyncio
import math
import threading
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from wasp_cli import seeds
from wasp_cli.drive.block import ALONE, Driven
from wasp_cli.drive.desk import Desk
from wasp_cli.drive.script import drive
from wasp_cli.drive.server import Server
from wasp_cli.drive.session import Session
from wasp_cli.plan.node import Cell, Node
from wasp_cli.store.artifact import exists
from wasp_cli.store.people import percentiles

TOLERATED = 0.02
"""Share of late decisions that is said to be in time."""
TOLERATED_FIRED = 0.1
"""The same of the decisions at which a gate fires: their 90th percentile is in time."""
TOLERATED_PACE = 1.05
"""By how much the world may slow down."""
BRIEF = 30
"""Decisions with which a session begins."""
SPEEDS = (1.0, 0.9, 0.8, 0.75, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25, 0.2, 0.1)
"""What is recommended."""


@dataclass(frozen=True)
class Timing:
    """How one method kept up."""

    label: str
    period_ms: float
    decisions: int
    late_share: float
    decision_ms: tuple[float, float]
    """median and 99th percentile of the answers, late ones too"""
    input_ms: tuple[float, float]
    """from the arrival of a key to the execution of what it commands; of decisions whose command was new"""
    round_trip_ms: tuple[float, float]
    speed: float
    """at which it was measured"""
    recommended: float
    pace: float
    """wall time of a decision in periods"""
    fired: int
    """answers with which a gate fired, late ones too"""
    fired_late_share: float
    """of these; 0 where there are none"""
    fired_ms: tuple[float, float]
    """their median and 90th percentile"""

    @property
    def in_time(self) -> bool:
        """Whether few enough decisions were late, and the world hardly slowed down."""
        return self.late_share <= TOLERATED and self.fired_late_share <= TOLERATED_FIRED and self.pace <= TOLERATED_PACE

    @property
    def where_gates_fired(self) -> str:
        """Say how well the decisions were in time that matter most."""
        if not self.fired:
            return f"{self.label}: no gate fired"
        median, most = self.fired_ms
        times = f"{median:.0f} ms (median), {most:.0f} ms (90th percentile)"
        return f"{self.label}: a gate fired at {self.fired} decisions: {times}, {self.fired_late_share:.0%} late"


def warning(session: Session) -> str | None:
    """Drive the first decisions of every condition that is to come; return what is to be said where they are not in time."""
    ahead = {
        (cell.task, cell.method, cell.assistant): (cell, node)
        for cell, node in session.blocks
        if cell.method != ALONE and not exists(session.layout, node.kind, node.key)
    }
    slow = [timing for timing in checked_blocks(replace(session, blocks=[*ahead.values()]), BRIEF) if not timing.in_time]
    if not slow:
        return None
    shares = ", ".join(f"{timing.label} {timing.late_share:.0%}, the world {timing.pace:.1f} times slower" for timing in slow)
    speed = min(timing.recommended for timing in slow)
    return f"this machine is busy or slow, and the assistant may be late (late: {shares}); --speed {speed:g} would keep it in time"


def checked_blocks(session: Session, most: int | None = None) -> list[Timing]:
    """Let the scripted driver drive an episode of each block, or its first `most` decisions; nothing is recorded."""
    found = []
    for cell, node in session.blocks:
        unrecorded = _Unrecorded(session, cell, node, most)
        desk = Desk()
        server = Server(desk)
        server.start()
        clock = threading.Thread(target=unrecorded.run, args=(desk,), daemon=True)
        clock.start()
        try:
            asyncio.run(drive(server.address))
            clock.join()
        finally:
            server.stop()
        found.append(unrecorded.timing())
    return found


class _Unrecorded:
    def __init__(self, session: Session, cell: Cell, node: Node, most: int | None) -> None:
        # The driver finds its way by the numbers of the map.
        self._session = replace(session, how=replace(session.how, shown=session.how.shown | {"map"}))
        self._cell, self._node, self._most = cell, node, most
        self._seconds: list[float] = []
        self._fired: list[tuple[float, bool]] = []
        self._driven: Driven | None = None
        self._failure: BaseException | None = None

    def run(self, desk: Desk) -> None:
        try:
            block = self._session.built(desk, self._cell, self._node, self._node.axes["method_config"])
            try:
                found = block.episode(0, seeds.derive("drive-check", self._cell.task), 0, {"of": 1}, self._most)
            finally:
                block.close()
            self._driven = found if isinstance(found, Driven) else None
            self._seconds, self._fired, self._period = block.answer_seconds, block.fired, block.period
        except BaseException as error:  # in a thread: told in the main one
            self._failure = error
        finally:
            desk.state("over", text="", blocks=[])

    def timing(self) -> Timing:
        if self._failure is not None:
            raise self._failure
        assert self._driven is not None
        beats, speed = self._driven.beats, self._session.how.speed
        fresh = [b.input_age_ms for a, b in pairwise(beats) if b.input != a.input]
        fired = [seconds for seconds, _ in self._fired]
        between = [b.at - a.at for a, b in pairwise(beats)]
        return Timing(
            self._node.label, 1000 * self._period, len(beats), float(np.mean([beat.late for beat in beats])),
            _ms(self._seconds), percentiles(fresh), percentiles([beat.round_trip_ms for beat in beats]), speed,
            recommended(self._seconds, fired, self._driven, self._period, speed),
            float(np.mean(between)) / self._period if between else 1.0,
            len(fired), float(np.mean([late for _, late in self._fired])) if fired else 0.0,
            (1000 * float(np.median(fired)), 1000 * float(np.quantile(fired, 1 - TOLERATED_FIRED))) if fired else (math.nan, math.nan),
        )  # fmt: skip


def recommended(seconds: list[float], fired: list[float], driven: Driven, period: float, speed: float) -> float:
    """Return the largest of SPEEDS at which all but a tolerated share of these answers would have been in time.

    Args:
        seconds: how long answers took.
        fired: how long those took with which a gate fired.
        driven: the episode; what a decision takes besides is the rest of the period that was kept free.
        period: of a decision in seconds, at `speed`.
        speed: at which it was measured.
    """
    besides = float(np.median([beat.rest_ms for beat in driven.beats])) / 1000
    answers = [np.quantile(each, 1 - share) for each, share in ((seconds, TOLERATED), (fired, TOLERATED_FIRED)) if each]
    needed = float(max(answers, default=0.0)) + besides
    return next((each for each in SPEEDS if period * speed / each >= needed), SPEEDS[-1])


def _ms(seconds: list[float]) -> tuple[float, float]:
    median, most = percentiles(seconds)
    return 1000 * median, 1000 * most


def as_json(timing: Timing) -> dict[str, Any]:
    """Return a timing as JSON values."""

    def known(value: float) -> float | None:
        return round(value, 2) if math.isfinite(value) else None

    pairs = {"decision": timing.decision_ms, "key_to_action": timing.input_ms, "round_trip": timing.round_trip_ms}
    numbers = {f"{name}_p{share}_ms": known(value) for name, pair in pairs.items() for share, value in zip((50, 99), pair, strict=True)}
    numbers |= {"pace": known(timing.pace), "fired_late_share": round(timing.fired_late_share, 4)}
    numbers |= {f"fired_p{share}_ms": known(value) for share, value in zip((50, 90), timing.fired_ms, strict=True)}
    return {
        "label": timing.label, "period_ms": timing.period_ms, "decisions": timing.decisions, "late_share": round(timing.late_share, 4),
        **numbers, "fired": timing.fired, "speed": timing.speed, "recommended": timing.recommended,
    }  # fmt: skip
