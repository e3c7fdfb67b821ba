"""What a block leaves behind: a cell like any other, with what the clock and the connection were like in two more files.

    _timing.pq      a row per decision: BEAT
    _session.json   who drove when, how fast, what was shown, pauses, episodes that were cut

Every finished episode is on disk before the next one begins. A block that ends early is the cell of as many episodes as were finished, so
that it is never taken for whole; the same session continued takes these over.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from wasp_cli.drive.block import Beat, Cut, Driven
from wasp_cli.drive.clock import percentiles
from wasp_cli.metrics.episode import episode_metrics
from wasp_cli.plan.node import Node
from wasp_cli.run.runner import job_of
from wasp_cli.run.worker import manifest_of
from wasp_cli.store.artifact import commit, read_record, staging_folder, write_record
from wasp_cli.store.layout import Layout
from wasp_cli.store.parquet import opened_table, write_table
from wasp_cli.store.tables import EPISODES_FILE, STEPS_FILE, CellIdentity, Thresholds, first_rows, read_episodes, write_cell

TIMING_FILE, SESSION_FILE = "_timing.pq", "_session.json"
VERSION_KEY, VERSION = b"wasp.timing", 1
BEAT = pa.schema(
    [
        pa.field("episode", pa.int32(), nullable=False),
        pa.field("t", pa.int32(), nullable=False),
        pa.field("at", pa.float64(), nullable=False),
        pa.field("decision_ms", pa.float32(), nullable=False),
        pa.field("late", pa.bool_(), nullable=False),
        pa.field("behind_ms", pa.float32(), nullable=False),
        pa.field("rest_ms", pa.float32(), nullable=False),
        pa.field("input", pa.int32(), nullable=False),
        pa.field("input_age_ms", pa.float32()),
        pa.field("round_trip_ms", pa.float32()),
        pa.field("keys", pa.string(), nullable=False),
        pa.field("focused", pa.bool_(), nullable=False),
    ],
    {VERSION_KEY: str(VERSION).encode()},
)
"""A decision; the meaning of the fields is that of `drive.block.Beat`. What is unknown is null."""


class CellRecord:
    """The rows of one cell while it is driven, in the folder where nodes keep what survives an interruption."""

    def __init__(
        self, layout: Layout, node: Node, identity: CellIdentity, goals: int, facts: Mapping[str, Any], begun: Path | None = None
    ) -> None:
        """Go on where the session broke off.

        Args:
            layout: the results folder.
            node: of the cell.
            identity: of its rows.
            goals: within an episode that count as success.
            facts: written into the session's file.
            begun: the folder of the same cell with fewer episodes, where there is one and nothing newer was left unfinished.
        """
        self._layout, self._node, self._identity, self._goals = layout, node, identity, goals
        self._folder = layout.work(node.key)
        self._folder.mkdir(parents=True, exist_ok=True)
        if begun is not None and not (self._folder / EPISODES_FILE).exists():
            for name in (TIMING_FILE, SESSION_FILE, STEPS_FILE, EPISODES_FILE):
                shutil.copyfile(begun / name, self._folder / name)
        earlier = self._earlier()
        self.finished = 0 if earlier is None else len(earlier.episodes)
        """Episodes that are on disk."""
        self._session = {**(read_record(self._folder / SESSION_FILE) or {"cut": [], "sittings": []})}
        self._session |= facts
        self._session["sittings"].append({"begun": _now(), "first_episode": self.finished})
        write_record(self._folder / SESSION_FILE, self._session)

    def _earlier(self) -> Any:
        return first_rows(self._folder, 1) if (self._folder / EPISODES_FILE).exists() else None

    def add(self, driven: Driven, thresholds: Thresholds, safe_cost: float) -> None:
        """Write a finished episode behind the others."""
        row = episode_metrics(driven.trajectory, self._goals, safe_cost)
        beats = pa.concat_tables([self._timing(), _beats(self.finished, driven.beats)])
        # The timing first: an episode counts once its rows are there, and the timing of one that does not is written again.
        write_table(beats, self._folder / TIMING_FILE)
        write_cell(
            self._folder, self._identity, [driven.trajectory], [row], thresholds, [driven.decision_ms], [driven.layout], self._earlier()
        )
        self._sitting(pauses=driven.pauses, paused_seconds=round(driven.paused_seconds, 1))
        self.finished += 1

    def cut(self, cut: Cut) -> None:
        """Note an episode that was given up."""
        self._session["cut"].append({"before_episode": self.finished, **asdict(cut)})
        write_record(self._folder / SESSION_FILE, self._session)

    def note(self, **facts: Any) -> None:
        """Write more into the session's file."""
        self._session |= facts
        write_record(self._folder / SESSION_FILE, self._session)

    def _sitting(self, **more: float) -> None:
        last = self._session["sittings"][-1]
        for name, value in more.items():
            last[name] = last.get(name, 0) + value
        last["ended"] = _now()
        write_record(self._folder / SESSION_FILE, self._session)

    def _timing(self) -> pa.Table:
        path = self._folder / TIMING_FILE
        known = read_timing(path) if path.exists() else BEAT.empty_table()
        return known.filter(pc.less(known["episode"], self.finished))

    def timing(self) -> dict[str, Any]:
        """Return how well decisions were in time, over all finished episodes."""
        return timing_summary(self._timing())

    def publish(self, run_id: str, node: Node) -> Path:
        """Make the rows the artifact of `node`: that of the whole cell, or of the same cell with as many episodes as there are."""
        summary = timing_summary(self._timing())
        numbers = read_episodes([self._folder / EPISODES_FILE])
        shown = {"return": ("return", 2), "cost": ("cost", 1), "int": ("int_rate", 3)}
        found = {name: round(float(np.mean(numbers[column])), digits) for name, (column, digits) in shown.items()}
        staging = staging_folder(self._layout, node.key)
        for path in self._folder.iterdir():
            shutil.copyfile(path, staging / path.name)
        job = job_of(self._layout, run_id, node)
        begun = str(self._session["sittings"][0]["begun"])
        seconds = float(self._timing()["at"].to_numpy().max(initial=0.0))
        made = commit(
            self._layout, node.kind, node.key, staging, manifest_of(job, {**found, "late": summary["late_share"]}, seconds, begun)
        )
        shutil.rmtree(self._folder, ignore_errors=True)
        return made


def _beats(episode: int, beats: Sequence[Beat]) -> pa.Table:
    columns: dict[str, list[Any]] = {"episode": [episode] * len(beats), "t": list(range(len(beats)))}
    columns |= {name: [getattr(beat, name) for beat in beats] for name in Beat._fields}
    return pa.table({field.name: pa.array(columns[field.name], field.type, from_pandas=True) for field in BEAT}, schema=BEAT)


def read_timing(path: Path) -> pa.Table:
    """Read the timing of a cell that a person drove.

    Raises:
        StoreError: the file is missing, damaged, of a newer version, or another table.
    """
    with opened_table(path, VERSION_KEY, VERSION, "the timing of a session") as file:
        return file.read()


def timing_summary(beats: pa.Table) -> dict[str, Any]:
    """Summarise decisions: how many, how many late, and percentiles of delays in ms; None where nothing is known."""
    late = np.asarray(beats["late"], bool)
    found: dict[str, Any] = {
        "decisions": len(late),
        "late": int(late.sum()),
        "late_share": round(float(late.mean()), 4) if len(late) else None,
    }
    for name in ("decision_ms", "behind_ms", "input_age_ms", "round_trip_ms"):
        values = np.array([np.nan if value is None else value for value in beats[name].to_pylist()], np.float64)
        for label, value in zip(("p50", "p99"), percentiles(values.tolist()), strict=True):
            found[f"{name[:-3]}_{label}_ms"] = None if value != value else round(value, 1)
    return found


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
