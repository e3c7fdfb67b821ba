"""Trained parts and tables of the report as Arrow tables: what needs the report's modules, imported when it is asked for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pyarrow as pa

from wasp_cli.errors import UnknownName
from wasp_cli.notebook.cells import chosen
from wasp_cli.report.provenance import last_runs
from wasp_cli.report.render import data_columns
from wasp_cli.report.summarize import report_run
from wasp_cli.report.trained.parts import NOT_TRAINED, Trained, scalars, trained_artifacts
from wasp_cli.run.record import read_run
from wasp_cli.store.artifact import stored_keys, stored_kinds
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout, is_key

MAIN = "main"  # the first table of a report, whatever its name


def trained_table(layout: Layout, cells: Iterable[str], parts: Sequence[tuple[str, str]], wanted: Mapping[str, Any]) -> pa.Table:
    roots = [*((KIND, key) for key in cells), *parts]
    if not roots:
        kinds = [kind for kind in stored_kinds(layout) if kind not in NOT_TRAINED]
        roots = [(kind, key) for kind in kinds for key in sorted(filter(is_key, stored_keys(layout, kind)))]
    shown = chosen(trained_artifacts(layout, roots)[0], wanted)
    columns: dict[str, list[Any]] = {
        "key": [part.key for part in shown],
        "kind": [part.kind for part in shown],
        "task": [part.task for part in shown],
        "seed": [part.seed for part in shown],
        "seconds": [part.seconds for part in shown],
        "folder": [str(layout.artifact(part.kind, part.key)) for part in shown],
    }
    numbers = [_numbers(part, columns) for part in shown]
    for name in dict.fromkeys(name for each in numbers for name in each):
        columns[name] = [each.get(name) for each in numbers]
    return pa.table({name: _array(values) for name, values in columns.items()})


def _numbers(part: Trained, taken: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{name}_" if name in taken else name: value for name, value in scalars(part.summary)}


def _array(values: Sequence[Any]) -> pa.Array:
    kinds = {bool if isinstance(value, bool) else float if isinstance(value, int | float) else type(value) for value in values} - {
        type(None)
    }
    if kinds == {float} and not all(isinstance(value, int | None) for value in values):
        return pa.array([None if value is None else float(value) for value in values], pa.float64())
    return pa.array(values) if len(kinds) == 1 else pa.array([None if value is None else str(value) for value in values], pa.string())


def report_table(layout: Layout, spec: str, name: str) -> pa.Table:
    run = read_run(layout, last_runs(layout)[0][spec])
    paper = None
    if name == "paper":
        from wasp_cli.spec.paper import load_paper

        paper = load_paper(None)
    report = report_run(layout.root, run.spec, run.cells, run.parts, paper, run.branched, run.unknown, run.absent)
    tables = {table.name: table for table in report.tables}
    known = {MAIN: report.tables[0], **tables} if tables else {}
    if name not in known:
        raise UnknownName("table", name, known)
    return pa.table(data_columns(known[name]))
