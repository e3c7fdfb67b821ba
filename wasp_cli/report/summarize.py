"""From a results folder to the report of a run: every table once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from wasp_cli.errors import ArtifactError
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import COUNTERFACTUAL
from wasp_cli.plan.node import Cell, Part
from wasp_cli.plan.recorded import last_plan, upstream_first
from wasp_cli.report.claims import judge
from wasp_cli.report.claims.text import numbers_table
from wasp_cli.report.document import Report
from wasp_cli.report.notes import invalid, notes_of, without_invalid
from wasp_cli.report.provenance import Origins, absent_fact, absent_parts, assumptions_in_force
from wasp_cli.report.stats import Frame, Wanted, read_frame, with_branches
from wasp_cli.report.tables import Table
from wasp_cli.report.tables.by_axis import operator_table, severity_table
from wasp_cli.report.tables.comparison import comparison_tables, necessity_table
from wasp_cli.report.tables.main import ablation_table, autonomy_table, detail_table, latency_table, main_table, threshold_table
from wasp_cli.report.tables.people import late_facts, people_fact, people_tables, read_people
from wasp_cli.report.tables.severity_check import check_table, checks_of, judged
from wasp_cli.report.trained import trained_artifacts
from wasp_cli.report.trained.tables import training_tables, with_warnings
from wasp_cli.spec.model import Spec
from wasp_cli.spec.paper import Paper
from wasp_cli.store.artifact import read_record
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity


def report_run(
    results: Path,
    spec: Spec,
    cells: Sequence[tuple[Cell, str]],
    parts: Sequence[tuple[Part, str]] = (),
    paper: Paper | None = None,
    branched: Sequence[tuple[Cell, str]] = (),
    unknown: Sequence[str] = (),
    absent: Sequence[str] = (),
) -> Report:
    """Summarise the cells and the trained parts of a run, each with the key of its artifact.

    Args:
        results: the results folder.
        spec: what the run was asked for.
        cells: its cells.
        parts: what it trains.
        paper: whose numbers and claims the cells are held against; None: against none.
        branched: the cells whose interventions are judged, with the keys of their counterfactual branches.
        unknown: what the record of the run has that this version does not know.
        absent: whose cells are left out, since it is not installed here, each as a sentence.
    """
    layout = Layout(results)
    wanted, damaged = wanted_cells(layout, spec, cells, branched)
    failures = {key: text for _, key in parts if (text := _failure(layout, key, damaged))}
    frame = stored = replace(with_branches(read_frame(wanted), wanted), absent=tuple(absent))
    keys = {identity_of(cell): key for cell, key in cells}
    notes = [note for note in notes_of(layout) if note.key in keys.values()]
    frame, left_out = without_invalid(frame, keys, invalid(notes))
    roots = [
        *(("evaluate", key) for _, key in cells),
        *((COUNTERFACTUAL, key) for _, key in branched),
        *((part.kind, key) for part, key in parts),
    ]
    origins = Origins()
    trained, unreadable = trained_artifacts(layout, roots, origins)
    trained = with_warnings(layout, trained)
    published = list(origins.facts())
    # What nothing needs is no gap in a run that took published results; in any other one it once was there.
    gone = absent_parts(layout, parts, spec.stages) if published and not stored.missing else []
    if gone:
        published.append(absent_fact(gone))
        # Of a stage that is there for other seeds the absent part stays: a mean over some of the seeds has to say so.
        told = {(part.task, part.kind) for part, _ in parts if part not in gone}
        parts = [(part, key) for part, key in parts if (part.task, part.kind) in told]
    remarks = (*origins.remarks(), *absent)
    sittings, unread = read_people(wanted, frame)
    damaged += unread
    # Of a task of one's own, and of people, the paper says nothing.
    judging = paper is not None and paper.tasks & {*spec.tasks} and any(cell.identity.operator != PERSON for cell in frame.cells)
    verdict = judge(frame, paper, spec) if paper is not None and judging else None
    front = [main_table(frame)] if cells else []
    if front and (late := late_facts(sittings)):
        front[0] = replace(front[0], notes=(*front[0].notes, *late))
    front += people_tables(sittings)
    front += [table for table in (ablation_table(frame), necessity_table(frame)) if table is not None]
    front += training_tables(parts, trained, {key: f"failed: {text}" for key, text in failures.items()})
    further = (
        None if verdict is None else numbers_table(verdict),
        *comparison_tables(frame),
        operator_table(frame),
        severity_table(frame),
        _severity_check(spec, frame),
        autonomy_table(frame),
        detail_table(frame),
        latency_table(frame),
        threshold_table(frame),
    )
    back = [table for table in further if table is not None and table.rows and table.columns]
    damaged = list(dict.fromkeys([*damaged, *unreadable]))
    return Report(
        name=spec.name,
        layout=layout,
        facts=(*((people_fact(sittings),) if sittings else ()), *_facts(spec, frame), *left_out, *published, *remarks, *unknown, *damaged),
        tables=(*front, *back),
        shown=len(front),
        frame=frame,
        trained=trained,
        assumptions=tuple(assumptions_in_force(spec)),
        damaged=tuple(damaged),
        published=tuple(published),
        remarks=remarks,
        verdict=verdict,
        keys=keys,
        notes=tuple(notes),
    )


def _severity_check(spec: Spec, frame: Frame) -> Table | None:
    """The operators alone, where cells without assistance stand beside the expert's."""
    if not {"human", "expert"} <= {identity.method for identity in frame.order}:
        return None
    checks = checks_of(spec, frame)
    return judged(check_table(checks, frame), checks)


def wanted_cells(
    layout: Layout, spec: Spec, cells: Sequence[tuple[Cell, str]], branched: Sequence[tuple[Cell, str]] = ()
) -> tuple[list[Wanted], list[str]]:
    """List the cells of a run with their places, and with what is known of why they are not there; and which records do not read.

    `branched` are those with counterfactual branches, each with the key of these.
    """
    damaged: list[str] = []
    # To look for the failure of each cell alone would take longer than to read the grid.
    failed = {path.stem for path in layout.failures.glob("*.json")}
    blocked = _blocked(layout, spec, failed, damaged)

    def wanted(cell: Cell, key: str, kind: str, branches: Wanted | None = None) -> Wanted:
        label = str(cell) if kind == KIND else f"{kind} of {cell}"
        known = {"severity": cell.severity, "blocked": blocked.get(key), "branches": branches, "chain_seed": spec.training_seed}
        failure = _failure(layout, key, damaged) if key in failed else None
        return Wanted.stored(layout, kind, key, identity_of(cell), label, failure=failure, **known)

    judged = {cell: wanted(cell, key, COUNTERFACTUAL) for cell, key in branched}
    return [wanted(cell, key, KIND, judged.get(cell)) for cell, key in cells], damaged


def _failure(layout: Layout, key: str, damaged: list[str]) -> str | None:
    """Why a node failed last; a record that does not read is added to `damaged`."""
    try:
        record = read_record(layout.failure(key))
    except ArtifactError as error:
        damaged.append(error.message)
        return error.message
    return None if record is None else f"{record.get('message')} (log: {record.get('log')})"


def _blocked(layout: Layout, spec: Spec, failed: set[str], damaged: list[str]) -> dict[str, str]:
    """What stands in the way of evaluations, by their keys: the failed nodes that they need, as the last run of the spec was planned.

    Not as the spec would be laid out now: that imports the environments that it names, and these results may be untrusted.
    """
    nodes = last_plan(layout, spec.name) if failed else {}
    causes: dict[str, str] = {}
    for node in upstream_first(nodes):
        upstream = [needed for needed in node.needs if needed in nodes and (needed in failed or needed in causes)]
        if upstream:
            first = nodes[upstream[0]]
            causes[node.key] = causes.get(first.key) or f"{first.label}, which failed: {_failure(layout, first.key, damaged)}"
    return causes


def identity_of(cell: Cell) -> CellIdentity:
    """Return a cell of a plan as its rows name it."""
    return CellIdentity(cell.task, cell.method, cell.assistant, cell.operator, cell.value, cell.seed)


def _facts(spec: Spec, frame: Frame) -> Iterator[str]:
    total = len(frame.cells) + len(frame.missing)
    episodes = sum(cell.count for cell in frame.cells)
    yield f"{len(frame.cells)} of {total} cells, {episodes} episodes." if total else "Training only: the spec lists no methods."
    yield f"Preset `{spec.preset}`, {spec.action_repeat} env steps per decision step."
    if spec.training_seed is not None:
        yield f"All evaluation seeds share the models of training seed {spec.training_seed}: ± does not contain the spread of training."
    elif len(spec.seeds) > 1 and total:
        yield "Every seed has its own models, so ± contains the spread of training."
