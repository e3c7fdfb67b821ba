"""What the runs of a results folder were to do, as each wrote it down: the one reader of
`plan.json`.

    for run_id in run_ids(layout): ...        all runs, newest first
    run = read_run(layout, run_id)            one of them; an ArtifactError where it does not read
    run.nodes, run.cells, run.parts           what it was to do
    last_runs(layout).runs["table1"]          the last run of a spec
    recorded_runs(layout).runs                the same of a folder that may have no runs

A folder may be half written, of another version, or untrusted. Each part of a plan is checked when
it is asked for: a run whose nodes cannot be read may still say which cells it has.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import (
    AliasChoices,
    BeforeValidator,
    Field,
    FiniteFloat,
    StringConstraints,
    TypeAdapter,
    ValidationError,
)

from wasp_cli.errors import ArtifactError, StoreError, UnknownName
from wasp_cli.plan.node import Cell, Part
from wasp_cli.plan.plan import IDLE
from wasp_cli.plan.unmeasured import Stepping
from wasp_cli.store.layout import Layout, is_name
from wasp_cli.store.plain import read_plain
from wasp_cli.store.records import read_record

if TYPE_CHECKING:
    from wasp_cli.cells.cell import RecordedCell

PLAN = "plan.json"
SWEEP = "sweep.json"
AGAIN = "run the spec again"

Key = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8,64}$")]  # as `layout.is_key`


@dataclass(frozen=True)
class PlannedNode:
    """A node as the plan of a run has it."""

    key: Key
    kind: str
    label: str
    state: str
    needs: Annotated[tuple[Key, ...], BeforeValidator(lambda needs: tuple(needs.values()))]
    seconds: FiniteFloat | None = None
    task: str = ""
    # in an environment that nobody had measured when it was planned: not in `seconds`
    decisions: Annotated[int, Field(ge=0, lt=2**53)] = 0
    # the part of `seconds` that several processes share
    stepping: Stepping | None = None

    @property
    def runs(self) -> bool:
        """Whether the run was to compute it."""
        return self.state not in IDLE


@dataclass(frozen=True)
class _CellEntry:
    """A cell as `plan.json` has it."""

    task: str
    method: str
    # plans of earlier versions call the ablation `assistant`
    variant: Annotated[str, Field(validation_alias=AliasChoices("variant", "assistant"))]
    operator: str
    severity: str | None
    value: FiniteFloat | Literal["auto"] | None
    seed: int
    key: Key

    @property
    def cell(self) -> Cell:
        """The point of the grid."""
        return Cell(
            self.task,
            self.method,
            self.variant,
            self.operator,
            self.severity,
            self.value,
            self.seed,
        )


@dataclass(frozen=True)
class _PartEntry:
    """A trained part as `plan.json` has it."""

    task: str
    kind: str
    seed: int
    key: Key


NODES = TypeAdapter(list[PlannedNode])
CELLS = TypeAdapter(list[_CellEntry])
PARTS = TypeAdapter(list[_PartEntry])

Entry = TypeVar("Entry")


@dataclass(frozen=True)
class RunRecord:
    """What a run was to do, as its folder says.

    `nodes`, `cells` and `parts` raise an ArtifactError where that part of the plan is damaged, or
    of another version.
    """

    layout: Layout
    run_id: str
    spec: str  # name of the spec; of a sweep with the setting that varies
    plans: tuple[Mapping[str, Any], ...]  # its plan; of a sweep that of each value
    values: tuple[str, ...] = ()  # the runs of a sweep's values, whose cells it computes

    @property
    def restricted(self) -> bool:
        """Whether it was asked for a part of its spec, as `Loaded.restricted`."""
        return any(plan.get("restricted") is True for plan in self.plans)

    @cached_property
    def nodes(self) -> Mapping[str, PlannedNode]:
        """The nodes by key, needed ones first, as the plan lists them."""
        return {node.key: node for node in self._entries("nodes", NODES)}

    @cached_property
    def cells(self) -> tuple[RecordedCell, ...]:
        """The cells, with the severities that were chosen for those that are computed."""
        # Imported here: who only follows runs needs no tables.
        from wasp_cli.cells.cell import recorded_cell

        # A cell that stands twice, under two names of one severity, is branched under both.
        branches = {entry.cell: entry.key for entry in self._entries("branched", CELLS, ())}
        return tuple(
            recorded_cell(self.layout, entry.cell, entry.key, self.spec, branches.get(entry.cell))
            for entry in self._entries("cells", CELLS)
        )

    @cached_property
    def parts(self) -> tuple[tuple[Part, str], ...]:
        """The trained parts, each with the key of its artifact."""
        return tuple(
            (Part(entry.task, entry.kind, entry.seed), entry.key)
            for entry in self._entries("parts", PARTS, ())
        )

    def _entries(
        self, name: str, adapter: TypeAdapter[list[Entry]], absent: Iterable[Entry] | None = None
    ) -> list[Entry]:
        """The entries of one list of the plan; `absent` where there is no such list."""
        entries: list[Entry] = []
        try:
            for plan in self.plans:
                if name in plan or absent is None:
                    entries += adapter.validate_python(plan[name])
        except ValidationError as error:
            raise self._damaged(_first_problem(name, error)) from error
        except KeyError as error:
            raise self._damaged(f"it has no {error}") from error
        except (TypeError, ValueError, AttributeError) as error:
            raise self._damaged(str(error)) from error
        return entries

    def _damaged(self, why: str) -> ArtifactError:
        return ArtifactError(f"cannot read the plan of run '{self.run_id}': {why}", AGAIN)


@dataclass(frozen=True)
class LastRuns:
    """The last run of each spec."""

    runs: dict[str, RunRecord]  # by name of the spec, oldest first
    damaged: tuple[str, ...]  # what is wrong with the runs whose plan does not read


def results_of(folder: Path) -> Layout:
    """Return the layout of an existing results folder; a StoreError where there is none, or it
    cannot be read or has links in it.
    """
    layout = Layout(folder)
    layout.require_own_folders()
    run_ids(layout)
    return layout


def run_ids(layout: Layout) -> list[str]:
    """Return the runs of a results folder, newest first: by the number that each wrote down, so
    that no wrong clock counts.

    Raises:
        StoreError: there is no such folder, it holds no runs, or it cannot be read.
    """
    try:
        with os.scandir(layout.within(layout.runs)) as entries:
            names = [
                entry.name
                for entry in entries
                if is_name(entry.name) and entry.is_dir(follow_symlinks=False)
            ]
    except (FileNotFoundError, NotADirectoryError) as error:
        what = "it holds no runs" if os.path.exists(layout.root) else "no such folder"
        raise StoreError(
            f"no results in '{layout.root}': {what}", "wasp run SPEC --results DIR writes there"
        ) from error
    except OSError as error:
        raise StoreError(
            f"cannot read the results in '{layout.root}': {(error.strerror or str(error)).lower()}"
        ) from error
    return sorted(names, key=lambda name: (order_of(layout, name), name), reverse=True)


def order_of(layout: Layout, run_id: str) -> int:
    """Return which of all runs one is, from 1 on; 0 where it does not say so."""
    with suppress(OSError, ValueError):
        return int(read_plain(layout.order(run_id)))
    return 0


def read_run(layout: Layout, run_id: str) -> RunRecord:
    """Read what a run was to do.

    Raises:
        ArtifactError: its folder has no plan, or one that is damaged.
    """
    sweep = _record(layout, run_id, SWEEP)
    if sweep is not None:
        return _read_sweep(layout, run_id, sweep)
    path = layout.run(run_id) / PLAN
    plan = _record(layout, run_id, PLAN)
    if plan is None:
        raise ArtifactError(f"'{path}' is missing", AGAIN)
    spec = plan.get("spec")
    if not isinstance(spec, str):
        raise ArtifactError(f"'{path}' is damaged: it names no spec", AGAIN)
    return RunRecord(layout, run_id, spec, (plan,))


def _read_sweep(layout: Layout, run_id: str, sweep: Mapping[str, Any]) -> RunRecord:
    """A run over several values of a setting: its plan is those of the runs of its values."""
    try:
        values = tuple(value["run"] for value in sweep["values"] if is_name(value["run"]))
        spec = f"{sweep['spec']} --vary {sweep['setting']}"
    except (LookupError, TypeError, AttributeError) as error:
        path = layout.run(run_id) / SWEEP
        raise ArtifactError(f"'{path}' is damaged: {error}", AGAIN) from error
    plans = [_record(layout, value, PLAN) for value in values]
    return RunRecord(
        layout, run_id, spec, tuple(plan for plan in plans if plan is not None), values
    )


def planned_run(layout: Layout, run_id: str) -> RunRecord | None:
    """Return a run whose nodes can be read; None where they cannot."""
    try:
        run = read_run(layout, run_id)
        _ = run.nodes
    except (ArtifactError, StoreError):
        return None
    return run


def planned_runs(layout: Layout, *, values: bool = False) -> list[RunRecord]:
    """Return all runs whose nodes can be read, newest first; those of a sweep's values are a part
    of the sweep, and come with `values` alone.
    """
    read = [planned_run(layout, run_id) for run_id in run_ids(layout)]
    runs = [run for run in read if run is not None]
    if values:
        return runs
    of_sweeps = {value for run in runs for value in run.values}
    return [run for run in runs if run.run_id not in of_sweeps]


def last_runs(layout: Layout) -> LastRuns:
    """Return the last run of each spec, and what is wrong with the runs whose plan does not read.

    Raises:
        StoreError: as `run_ids`.
    """
    runs: dict[str, RunRecord] = {}
    damaged: list[str] = []
    for run_id in reversed(run_ids(layout)):
        if not (layout.run(run_id) / PLAN).exists():
            continue  # a sweep, or a run that is being planned
        try:
            run = read_run(layout, run_id)
        except ArtifactError as error:
            damaged.append(error.message)
            continue
        runs.pop(run.spec, None)
        runs[run.spec] = run
    return LastRuns(runs, tuple(damaged))


def recorded_runs(layout: Layout) -> LastRuns:
    """Return the last run of each spec, as `last_runs`; none of a folder without runs, such as one
    of published results.

    Raises:
        StoreError: there is no such folder.
    """
    if not layout.root.is_dir():
        raise StoreError(
            f"no results in '{layout.root}': no such folder",
            "wasp run SPEC --results DIR writes there",
        )
    try:
        return last_runs(layout)
    except StoreError:
        return LastRuns({}, ())


def last_plan(layout: Layout, spec: str) -> Mapping[str, PlannedNode]:
    """Return what the last run of a spec was to do; empty where none is recorded."""
    with suppress(StoreError):
        for run_id in run_ids(layout):
            run = planned_run(layout, run_id)
            if run is not None and run.spec == spec:
                return run.nodes
    return {}


def named_run(runs: Sequence[RunRecord], text: str) -> RunRecord:
    """Return the run of a name, or the newest of the spec of this name, or the newest whose
    name ends so.

    Raises:
        UnknownName: there is none.
    """
    named = [run for run in runs if text in (run.run_id, run.spec)]
    if not named and text:
        named = [run for run in runs if run.run_id.endswith(text)]
    if not named:
        raise UnknownName("run", text, [run.run_id for run in runs])
    return named[0]


def keys_of(layout: Layout, run: str | None, text: str) -> frozenset[str] | None:
    """Return the keys that a label or the beginning of a key may mean; None: any.

    Those of the run that `named_run` finds. Without one, those that a label has from the newest run
    on that left something of it.
    """
    from wasp_cli.store.named import same_label

    if run is not None:
        return frozenset(named_run(planned_runs(layout, values=True), run).nodes)
    keys: set[str] = set()
    label = " ".join(text.split())
    with suppress(StoreError):  # a folder without runs
        for planned in planned_runs(layout):
            nodes = [node for node in planned.nodes.values() if same_label(node.label, label)]
            keys.update(node.key for node in nodes)
            if any(layout.artifact(node.kind, node.key).is_dir() for node in nodes):
                return frozenset(keys)
    return None


def _record(layout: Layout, run_id: str, name: str) -> dict[str, Any] | None:
    return read_record(layout.within(layout.run(run_id)) / name)


def _first_problem(name: str, error: ValidationError) -> str:
    """The first of the problems with a list of a plan, with its place."""
    problem = error.errors(include_url=False, include_input=False)[0]
    place = ".".join(str(part) for part in (name, *problem["loc"]))
    return f"{place}: {problem['msg']}"
