"""`wasp drive --check`: is this machine fast enough? One unrecorded episode by a scripted driver, through the real socket."""

from __future__ import annotations

import asyncio
import math
import threading
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from wasp_cli import seeds
from wasp_cli.drive.block import Driven
from wasp_cli.drive.desk import Desk
from wasp_cli.drive.script import drive
from wasp_cli.drive.server import Server
from wasp_cli.drive.session import Session
from wasp_cli.plan.node import Cell, Node
from wasp_cli.store.people import percentiles

TOLERATED = 0.02
"""Share of late decisions that is said to be in time."""
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

    @property
    def in_time(self) -> bool:
        """Whether at most TOLERATED of the decisions were late."""
        return self.late_share <= TOLERATED


def checked_blocks(session: Session) -> list[Timing]:
    """Let the scripted driver drive an episode of each block; nothing is recorded."""
    found = []
    for cell, node in session.blocks:
        unrecorded = _Unrecorded(session, cell, node)
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
    def __init__(self, session: Session, cell: Cell, node: Node) -> None:
        # The driver finds its way by the numbers of the map.
        self._session = replace(session, how=replace(session.how, shown=session.how.shown | {"map"}))
        self._cell, self._node = cell, node
        self._seconds: list[float] = []
        self._driven: Driven | None = None

    def run(self, desk: Desk) -> None:
        block = self._session.built(desk, self._cell, self._node, self._node.axes["method_config"])
        try:
            found = block.episode(0, seeds.derive("drive-check", self._cell.task), 0, {"of": 1})
            self._driven = found if isinstance(found, Driven) else None
            self._seconds, self._period = block.answer_seconds, block.period
        finally:
            block.close()
            desk.state("over", text="", blocks=[])

    def timing(self) -> Timing:
        assert self._driven is not None
        beats, speed = self._driven.beats, self._session.how.speed
        fresh = [b.input_age_ms for a, b in pairwise(beats) if b.input != a.input]
        return Timing(
            self._node.label, 1000 * self._period, len(beats), float(np.mean([beat.late for beat in beats])),
            _ms(self._seconds), percentiles(fresh), percentiles([beat.round_trip_ms for beat in beats]), speed,
            recommended(self._seconds, self._driven, self._period, speed),
        )  # fmt: skip


def recommended(seconds: list[float], driven: Driven, period: float, speed: float) -> float:
    """Return the largest of SPEEDS at which all but TOLERATED of these answers would have been in time.

    Args:
        seconds: how long answers took.
        driven: the episode; what a decision takes besides is the rest of the period that was kept free.
        period: of a decision in seconds, at `speed`.
        speed: at which it was measured.
    """
    besides = float(np.median([beat.rest_ms for beat in driven.beats])) / 1000
    needed = float(np.quantile(seconds, 1 - TOLERATED)) + besides
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
    return {
        "label": timing.label, "period_ms": timing.period_ms, "decisions": timing.decisions, "late_share": round(timing.late_share, 4),
        **numbers, "speed": timing.speed, "recommended": timing.recommended,
    }  # fmt: skip
