"""What a run writes of itself: its folder with the plan, and the journal of its events."""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from wasp_cli.errors import ArtifactError, StoreError, refusal
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.node import Cell, Part
from wasp_cli.plan.plan import Plan, Thing
from wasp_cli.plan.recorded import order_of, run_ids
from wasp_cli.run.process import this_process
from wasp_cli.spec.load import Loaded, Sweep
from wasp_cli.spec.model import Spec, spec_type
from wasp_cli.spec.names import RECORDED
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import append_line, read_plain
from wasp_cli.store.records import read_record, write_record

CELL, PART = TypeAdapter(Cell), TypeAdapter(Part)
REQUIRED = ("name", "tasks", "seeds")  # without one of them there is nothing to report


@dataclass(frozen=True)
class Recorded:
    run_id: str
    spec: Spec
    cells: list[tuple[Cell, str]]  # each cell with the key of its artifact
    parts: list[tuple[Part, str]]
    branched: list[tuple[Cell, str]] = field(default_factory=list)
    """Each cell whose interventions were to be judged with the key of its counterfactual
    branches.
    """
    unknown: tuple[str, ...] = ()
    """What its record has that this version does not know, each as a sentence; it stays in the
    record, and is in no table.
    """
    absent: tuple[str, ...] = ()


def new_run(layout: Layout, loaded: Loaded, plan: Plan, *, reports: bool = False) -> str:
    """Make the folder of a new run and write down what it is asked for; with `reports` a report
    follows.
    """
    spec = loaded.spec
    with _new_folder(layout, spec.name, reports) as folder:
        (folder / "spec.yaml").write_text(loaded.chain.text, encoding="utf-8")
        write_record(folder / "spec.json", spec.model_dump(mode="json"))
        record = {"spec": spec.name, "restricted": loaded.restricted, **plan.as_json()}
        write_record(folder / "plan.json", record, compact=True)  # has a line for every input else
    return folder.name


def new_sweep(
    layout: Layout, sweep: Sweep, plan: Plan, grids: Sequence[Grid], *, reports: bool = False
) -> str:
    """Make the folder of a sweep, which has its logs, and one more run for each value, so that
    reports find its cells.
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
        write_record(
            folder / "sweep.json", {"spec": sweep.spec, "setting": sweep.key, "values": values}
        )
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
        # or `wasp gc`, which makes room, would wait for its plan
        shutil.rmtree(folder, ignore_errors=True)
        if not isinstance(error, OSError):
            raise
        raise StoreError(
            f"cannot write to '{folder}': {(error.strerror or str(error)).lower()}"
        ) from error


def read_run(layout: Layout, run_id: str) -> Recorded:
    """Return what a run was asked for; an ArtifactError where its record is damaged, or of
    another version.
    """
    folder = layout.within(layout.run(run_id))
    try:
        spec, unknown = _known_part(json.loads(read_plain(folder / "spec.json")))
    except (OSError, ValueError) as error:  # a ValidationError is a ValueError
        raise ArtifactError(
            f"cannot read the spec of run '{run_id}': {first_line(error)}", "run the spec again"
        ) from error
    try:
        record = read_record(folder / "plan.json") or {}
        cells, branched = (_read(CELL, record[name]) for name in ("cells", "branched"))
        parts = [(part, key) for part, key in _read(PART, record["parts"]) if part.kind in STAGES]
    except (KeyError, TypeError, AttributeError, ValidationError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else first_line(error)
        raise ArtifactError(
            f"cannot read the plan of run '{run_id}': {what}", "run the spec again"
        ) from error
    known = {
        cell
        for cell, _ in cells
        if cell.method in METHODS and cell.operator in (*OPERATORS, UNIMPAIRED)
    }
    left_out = Counter(
        cell.method if cell.method not in METHODS else cell.operator
        for cell, _ in cells
        if cell not in known
    )
    absent = [
        f"{name}: not installed here; "
        f"{'its cell is' if count == 1 else f'its {count} cells are'} left out."
        for name, count in sorted(left_out.items())
    ]
    cells, branched = (
        [(cell, key) for cell, key in part if cell in known] for part in (cells, branched)
    )
    return Recorded(run_id, spec, cells, parts, branched, tuple(unknown), tuple(absent))


def _known_part(document: Any) -> tuple[Spec, list[str]]:
    """The spec without what is not known here (another version wrote it, or a plugin that is
    absent now), and what that was.
    """
    unknown: list[str] = []
    while True:
        try:
            return spec_type().model_validate_json(
                json.dumps(document), strict=True, context={RECORDED: True}
            ), unknown
        except ValidationError as error:
            # One at a time: taking an entry out of a list moves those behind it.
            names = (
                _taken_out(document, problem["loc"]) for problem in error.errors(include_url=False)
            )
            name = next((name for name in names if name is not None), None)
            if name is None or len(unknown) > 200:  # a folder may be hostile
                raise
            unknown.append(
                f"The spec has `{name}`, which is not known here: an absent plugin's, or "
                "another version's."
            )


def _taken_out(document: Any, loc: Sequence[str | int]) -> str | None:
    """Take the deepest thing out of a document that a place names; return its dotted name, or
    None where nothing may be taken out.
    """
    node: Any = document
    way: list[tuple[Any, Any]] = []
    for part in loc:
        if (isinstance(node, dict) and part in node) or (
            isinstance(node, list) and isinstance(part, int) and part < len(node)
        ):
            way.append((node, part))
            node = node[part]  # type: ignore[index]
    if not way or (len(way) == 1 and way[0][1] in REQUIRED):
        return None
    parent, name = way[-1]
    shown = ".".join(str(part) for _, part in way[:-1])
    value = parent.pop(name)
    if isinstance(parent, list):
        return f"{shown}: {value}"
    return f"{shown}.{name}" if shown else str(name)


def _read(
    adapter: TypeAdapter[Thing], entries: Sequence[Mapping[str, Any]]
) -> list[tuple[Thing, str]]:
    return [(adapter.validate_python(entry), str(entry["key"])) for entry in entries]


def first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]


def results_of(folder: Path) -> Layout:
    """Return the layout of an existing results folder; a StoreError where there is none, or it
    cannot be read or has links in it.
    """
    layout = Layout(folder)
    layout.require_own_folders()
    run_ids(layout)
    return layout


class Journal:
    """Appends events to `journal.jsonl`. Each is one write, so that a signal handler may write
    one too, and lines never mix.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
        # the kernel lets go of it however this process ends: so its end is seen from other machines
        # too
        self.locked = False
        with suppress(OSError):  # a file system without locks
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.locked = True
        # what kept an event from being written whole; the first one
        self.failure: StoreError | None = None

    def write(self, event: str, **facts: Any) -> None:
        """Append one event with its time. A full disk does not end the run, which says at its
        end what could not be written.
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
        file, self._file = self._file, -1
        os.close(file)


class Tail:
    def __init__(self, path: Path) -> None:
        self._path, self._position = path, 0

    def new(self) -> Iterator[dict[str, Any]]:
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
