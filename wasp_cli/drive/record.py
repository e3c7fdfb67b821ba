"""What a block leaves behind: a cell like any other, with what the clock and the connection were like in two more files (`store.people`).

Every finished episode is on disk before the next one begins. A block that ends early is the cell of as many episodes as were finished, so
that it is never taken for whole; the same session continued takes these over.
"""

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

from wasp_cli.console import waiting_aloud
from wasp_cli.drive.block import Beat, Cut, Driven
from wasp_cli.metrics.episode import episode_metrics
from wasp_cli.plan.node import Node
from wasp_cli.run.runner import job_of
from wasp_cli.run.worker import manifest_of
from wasp_cli.store.artifact import commit, read_record, staging_folder, write_record
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held
from wasp_cli.store.parquet import write_table
from wasp_cli.store.people import BEAT, SESSION_FILE, TIMING_FILE, read_timing, timing_summary
from wasp_cli.store.tables import EPISODES_FILE, STEPS_FILE, CellIdentity, Thresholds, first_rows, read_episodes, write_cell
from wasp_cli.tasks.registry import TASKS


class CellRecord:
    """The rows of one cell while it is driven, in the folder where nodes keep what survives an interruption."""

    def __init__(
        self, layout: Layout, node: Node, identity: CellIdentity, goals: int, facts: Mapping[str, Any], begun: Path | None = None
    ) -> None:
        """Go on where the session broke off, or from `begun`, the same cell with fewer episodes."""
        self._layout, self._node, self._identity, self._goals = layout, node, identity, goals
        self._folder = layout.work(node.key)
        self._folder.mkdir(parents=True, exist_ok=True)
        if begun is not None and not (self._folder / EPISODES_FILE).exists():
            for name in (TIMING_FILE, SESSION_FILE, STEPS_FILE, EPISODES_FILE):
                shutil.copyfile(begun / name, self._folder / name)
        earlier = self._earlier()
        self.finished = 0 if earlier is None else len(earlier.episodes)
        self._session = {**(read_record(self._folder / SESSION_FILE) or {"cut": [], "sittings": []})}
        self._session |= facts
        self._session["sittings"].append({"begun": _now(), "first_episode": self.finished})
        self.note()

    def _earlier(self) -> Any:
        return first_rows(self._folder, 1) if (self._folder / EPISODES_FILE).exists() else None

    def add(self, driven: Driven, thresholds: Thresholds, safe_cost: float) -> None:
        row = episode_metrics(driven.trajectory, self._goals, safe_cost, TASKS[self._identity.task].motors.force)
        count = len(driven.beats)
        columns: dict[str, list[Any]] = {"episode": [self.finished] * count, "t": list(range(count))}
        columns |= {name: [getattr(beat, name) for beat in driven.beats] for name in Beat._fields}
        rows = pa.table({field.name: pa.array(columns[field.name], field.type, from_pandas=True) for field in BEAT}, schema=BEAT)
        beats = pa.concat_tables([self._timing(), rows])
        # The timing first: an episode counts once its rows are there, and the timing of one that does not is written again.
        write_table(beats, self._folder / TIMING_FILE)
        write_cell(
            self._folder, self._identity, [driven.trajectory], [row], thresholds, [driven.decision_ms], [driven.layout], self._earlier()
        )
        sitting = self._session["sittings"][-1]
        sitting["pauses"] = sitting.get("pauses", 0) + driven.pauses
        sitting["paused_seconds"] = sitting.get("paused_seconds", 0) + round(driven.paused_seconds, 1)
        sitting["ended"] = _now()
        self.note()
        self.finished += 1

    def cut(self, cut: Cut) -> None:
        self._session["cut"].append({"before_episode": self.finished, **asdict(cut)})
        self.note()

    def note(self, **facts: Any) -> None:
        self._session |= facts
        write_record(self._folder / SESSION_FILE, self._session)

    def _timing(self) -> pa.Table:
        path = self._folder / TIMING_FILE
        known = read_timing(path) if path.exists() else BEAT.empty_table()
        return known.filter(pc.less(known["episode"], self.finished))

    def publish(self, run_id: str, node: Node) -> dict[str, Any]:
        """Make the rows the artifact of `node`: that of the whole cell, or of the same cell with as many episodes as there are."""
        summary = timing_summary(self._timing())
        numbers = read_episodes([self._folder / EPISODES_FILE])
        shown = {"return": ("return", 2), "cost": ("cost", 1), "int": ("int_rate", 3)}
        measures = {name: round(float(np.mean(numbers[column])), digits) for name, (column, digits) in shown.items()}
        job = job_of(self._layout, run_id, node)
        begun = str(self._session["sittings"][0]["begun"])
        seconds = float(self._timing()["at"].to_numpy().max(initial=0.0))
        manifest = manifest_of(job, {**measures, "late": summary["late_share"]}, seconds, begun)
        with held(self._layout.lock(node.key), waiting_aloud(f"{node.label} is written by another process; waiting")):
            staging = staging_folder(self._layout, node.key)
            for path in self._folder.iterdir():
                shutil.copyfile(path, staging / path.name)
            commit(self._layout, node.kind, node.key, staging, manifest)
        shutil.rmtree(self._folder, ignore_errors=True)
        return summary


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
