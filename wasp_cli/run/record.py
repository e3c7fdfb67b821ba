"""The records of a run: its folder with the plan, and the journal of its events."""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from wasp_cli.cells.runs import PLAN, SWEEP, order_of, run_ids
from wasp_cli.errors import StoreError, refusal
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.plan import Plan
from wasp_cli.run.process import this_process
from wasp_cli.spec.load import Loaded, Sweep
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import append_line
from wasp_cli.store.records import write_record


def new_run(layout: Layout, loaded: Loaded, plan: Plan, *, reports: bool = False) -> str:
    """Make the folder of a new run and write its spec and plan there. With `reports` the run is
    marked as one that a report will follow. Returns its id.

    Raises:
        StoreError: the folder cannot be written.
    """
    spec = loaded.spec
    with _new_folder(layout, spec.name, reports) as folder:
        (folder / "spec.yaml").write_text(loaded.chain.text, encoding="utf-8")
        write_record(folder / "spec.json", spec.model_dump(mode="json"))
        record = {"spec": spec.name, "restricted": loaded.restricted, **plan.as_json()}
        write_record(folder / PLAN, record, compact=True)  # else it has a line for every input
    return folder.name


def new_sweep(
    layout: Layout, sweep: Sweep, plan: Plan, grids: Sequence[Grid], *, reports: bool = False
) -> str:
    """Make the folder of a sweep, which has its logs, and a run for each value, by which reports
    find its cells. Returns the id of the sweep.
    """
    runs = [
        new_run(layout, point.loaded, plan.of(grid))
        for point, grid in zip(sweep.points, grids, strict=True)
    ]
    with _new_folder(layout, sweep.name, reports) as folder:
        values = [
            {"value": point.value, "run": run}
            for point, run in zip(sweep.points, runs, strict=True)
        ]
        write_record(folder / SWEEP, {"spec": sweep.spec, "setting": sweep.key, "values": values})
    return folder.name


@contextmanager
def _new_folder(layout: Layout, name: str, reports: bool) -> Iterator[Path]:
    folder = layout.run(f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{name[:60]}-{secrets.token_hex(2)}")
    try:
        for part in ("logs", "running"):
            (folder / part).mkdir(parents=True)
        last = max((order_of(layout, name) for name in run_ids(layout)), default=0)
        layout.order(folder.name).write_text(f"{last + 1}\n", encoding="utf-8")
        if reports:
            write_record(layout.reporting(folder.name), this_process())
        yield folder
    except BaseException as error:
        # Removed, since `wasp gc`, which makes room, would wait for its plan.
        shutil.rmtree(folder, ignore_errors=True)
        if not isinstance(error, OSError):
            raise
        raise StoreError(
            f"cannot write to '{folder}': {(error.strerror or str(error)).lower()}"
        ) from error


class Journal:
    """Appends events to `journal.jsonl`. Each event is one write, so that a signal handler may
    write one too, and lines never mix.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
        # The kernel releases the lock however this process ends, so that its end is seen from other
        # machines too.
        self.locked = False
        with suppress(OSError):  # a file system without locks
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.locked = True
        # what kept an event from being written whole; the first one
        self.failure: StoreError | None = None

    def write(self, event: str, **facts: Any) -> None:
        """Append an event with its time. If the disk is full, the run goes on, and `failure` says
        at its end what could not be written.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        if self._file < 0:
            return
        try:
            append_line(self._file, json.dumps({"at": now, "event": event, **facts}))
        except OSError as error:
            what = f"the journal '{self._path}' is not whole: {refusal(error).message}"
            self.failure = self.failure or StoreError(
                what, "results are kept; make room, and run the same command again"
            )

    def close(self) -> None:
        """Close the file, which releases its lock; later events are dropped."""
        file = self._file
        self._file = -1  # first: a signal handler may write an event now
        os.close(file)


class Tail:
    """Reads a journal while it is being written."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._position = 0

    def new(self) -> Iterator[dict[str, Any]]:
        """Yield the events that were appended since the last call. A line that is not whole yet
        comes later.
        """
        try:
            with self._path.open("rb") as file:
                file.seek(self._position)
                text = file.read()
        except FileNotFoundError:
            return
        whole, newline, _ = text.rpartition(b"\n")
        self._position += len(whole) + len(newline)
        for line in whole.splitlines():
            with suppress(ValueError):
                yield json.loads(line)
