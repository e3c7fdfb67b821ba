"""A cell while a person drives it: every episode is on disk when it ends."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from wasp_cli.drive.block import Beat, Cut, Driven
from wasp_cli.drive.desk import NEXT
from wasp_cli.metrics.episode import episode_metrics
from wasp_cli.plan.node import Node
from wasp_cli.run.runner import job_of
from wasp_cli.run.worker import manifest_of
from wasp_cli.store.artifact import (
    commit,
    discard,
    staging_folder,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.parquet import write_table
from wasp_cli.store.people import BEAT, SESSION_FILE, TIMING_FILE, read_timing, timing_summary
from wasp_cli.store.records import read_record, write_record
from wasp_cli.store.tables import (
    EPISODES_FILE,
    STEPS_FILE,
    CellIdentity,
    Thresholds,
    first_rows,
    read_episodes,
    write_cell,
)
from wasp_cli.tasks.registry import TASKS


class CellRecord:
    """The episodes of a cell that a person drives, in one or more sittings.

    They lie in the working folder of the node, and become an artifact at the end of a sitting.
    """

    def __init__(
        self,
        layout: Layout,
        node: Node,
        identity: CellIdentity,
        goals: int,
        facts: Mapping[str, Any],
        begun: Path | None = None,
    ) -> None:
        """Go on with the episodes of an earlier sitting, or begin the first one.

        Args:
            goals: how many of them are a success.
            facts: of the session: who drives, how, and in which study.
            begun: folder of an artifact with the first episodes, from which this one goes on.
        """
        self._layout = layout
        self._node = node
        self._identity = identity
        self._goals = goals
        self._folder = layout.work(node.key)
        self._folder.mkdir(parents=True, exist_ok=True)
        if begun is not None and not (self._folder / EPISODES_FILE).exists():
            for name in (TIMING_FILE, SESSION_FILE, STEPS_FILE, EPISODES_FILE):
                shutil.copyfile(begun / name, self._folder / name)
        earlier = self._earlier()
        self.finished = 0 if earlier is None else len(earlier.episodes)
        before = read_record(self._folder / SESSION_FILE) or {"cut": [], "sittings": []}
        self._session = {**before, **facts}
        # a later sitting may have another speed
        how = {name: facts[name] for name in ("speed", "shown") if name in facts}
        self._session["sittings"].append({"begun": _now(), "first_episode": self.finished, **how})
        self.note()

    @property
    def skipped(self) -> int:
        """How many worlds the driver has skipped."""
        return sum(cut["why"] == NEXT for cut in self._session["cut"])

    def _earlier(self) -> Any:
        """The rows of the episodes so far; None before the first one."""
        if not (self._folder / EPISODES_FILE).exists():
            return None
        return first_rows(self._folder, 1)

    def add(self, driven: Driven, thresholds: Thresholds, safe_cost: float) -> None:
        """Write down an episode that was driven to its end."""
        row = episode_metrics(
            driven.trajectory, self._goals, safe_cost, TASKS[self._identity.task].motors.force
        )
        count = len(driven.beats)
        columns: dict[str, list[Any]] = {
            "episode": [self.finished] * count,
            "t": list(range(count)),
        }
        columns |= {name: [getattr(beat, name) for beat in driven.beats] for name in Beat._fields}
        rows = pa.table(
            {
                field.name: pa.array(columns[field.name], field.type, from_pandas=True)
                for field in BEAT
            },
            schema=BEAT,
        )
        # The timing is written first. An episode counts once its rows are there; the timing of one
        # that does not count is written again.
        write_table(pa.concat_tables([self._timing(), rows]), self._folder / TIMING_FILE)
        write_cell(
            self._folder,
            self._identity,
            [driven.trajectory],
            [row],
            thresholds,
            [driven.decision_ms],
            [driven.layout],
            self._earlier(),
        )
        sitting = self._session["sittings"][-1]
        paused = round(driven.paused_seconds, 1)
        sitting["pauses"] = sitting.get("pauses", 0) + driven.pauses
        sitting["paused_seconds"] = sitting.get("paused_seconds", 0) + paused
        sitting["ended"] = _now()
        self.note()
        self.finished += 1

    def cut(self, cut: Cut) -> None:
        """Write down that an episode was given up, and why."""
        self._session["cut"].append({"before_episode": self.finished, **asdict(cut)})
        self.note()

    def count(self, **more: int) -> None:
        """Add to counts of the session."""
        self.note(**{name: self._session.get(name, 0) + number for name, number in more.items()})

    def note(self, **facts: Any) -> None:
        """Write down facts of the session."""
        self._session |= facts
        write_record(self._folder / SESSION_FILE, self._session)

    def _timing(self) -> pa.Table:
        """The timing of the episodes that count."""
        path = self._folder / TIMING_FILE
        known = read_timing(path) if path.exists() else BEAT.empty_table()
        return known.filter(pc.less(known["episode"], self.finished))

    def publish(self, run_id: str, node: Node) -> dict[str, Any]:
        """Store what was driven as the artifact of a node, of as many episodes as there are.

        Returns:
            The summary of their timing.
        """
        summary = timing_summary(self._timing())
        numbers = read_episodes([self._folder / EPISODES_FILE])
        shown = {"return": ("return", 2), "cost": ("cost", 1), "int": ("int_rate", 3)}
        measures = {
            name: round(float(np.mean(numbers[column])), digits)
            for name, (column, digits) in shown.items()
        }
        begun = str(self._session["sittings"][0]["begun"])
        seconds = float(self._timing()["at"].to_numpy().max(initial=0.0))
        manifest = manifest_of(
            job_of(self._layout, run_id, node),
            {**measures, "late": summary["late_share"]},
            seconds,
            begun,
        )
        # The staging folder of the node whose lock is held: it is not taken for one that a killed
        # process has left.
        staging = staging_folder(self._layout, self._node.key)
        shutil.copytree(self._folder, staging, dirs_exist_ok=True)
        place = self._layout.artifact(node.kind, node.key)
        # The same episodes may be there already, if this sitting finished none. Then its record of
        # skipped worlds and pauses replaces the earlier one.
        before = read_record(place / SESSION_FILE)
        if before:
            sittings = before["sittings"]
            if sittings == self._session["sittings"][: len(sittings)]:
                discard(place)
        commit(self._layout, node.kind, node.key, staging, manifest)
        shutil.rmtree(self._folder, ignore_errors=True)
        return summary


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
