"""The report of a sweep: a table with a row for each assistant and value, printed, written, or
for machines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from wasp_cli.cells.asked import Asked
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.read import Missing
from wasp_cli.cells.table import CellTable
from wasp_cli.report.render import make_own, markdown, markdown_text, terminal, write_pages
from wasp_cli.report.stats import Frame, Group, row_of
from wasp_cli.report.summarize import name_missing, report_run
from wasp_cli.report.summary import Value, paired_difference, spread_note
from wasp_cli.report.tables import Row, Table, main
from wasp_cli.spec.load import Sweep

REFERENCE = "human"
COLUMNS = (
    *main.PAPER_COLUMNS,
    *(column for column in main.MORE_COLUMNS if column.key == "mag_int"),
)
UNTOUCHED = "-"  # the value of a method whose cells are the same for every value
UNTOUCHED_NOTE = (
    f"{UNTOUCHED} in place of a value: the setting does not touch this method, whose cells are "
    "the same for every value."
)
DIFFERENCE = (
    "In brackets: mean difference to Human-only over the operators, severities and seeds that "
    "both have."
)
CHOICE = (
    "The best of several values looks better than it is: choose on seeds that no table uses, "
    "and report on others."
)


@dataclass(frozen=True, eq=False)
class Swept:
    """One value of the setting, with the cells that it asks for."""

    text: str  # the value as it was written
    value: Any  # the same as a file would have it
    frame: Frame  # two values share a cell when its key is the same


@dataclass(frozen=True, eq=False)
class Line:
    """A row of the table: an assistant on a task, under one value."""

    group: Group
    swept: Swept | None  # None where the setting does not touch the assistant
    # the cells of Human-only under the same value; None for itself, and where it does not run
    reference: CellTable | None

    @property
    def text(self) -> str:
        """The value as it was written; UNTOUCHED if the setting does not touch the assistant."""
        return UNTOUCHED if self.swept is None else self.swept.text

    @property
    def values(self) -> tuple[Value, ...]:
        """The numbers of the row, with differences to Human-only. The columns of autonomy have
        none: Human-only corrects nothing.
        """
        values = list(main.values(self.group, COLUMNS))
        for place, column in enumerate(COLUMNS):
            if self.reference is not None and column.key not in main.AUTONOMY:
                delta = paired_difference(self.group.cells, self.reference, column.key)
                values[place] = replace(values[place], delta=delta)
        return tuple(values)

    def as_json(self) -> dict[str, Any]:
        """Return the row as JSON values: the assistant, the value, how many cells it has, and each
        measure with its spread, difference and number of seeds.
        """
        facts: dict[str, Any] = {
            "task": self.group.task,
            "method": self.group.method,
            "variant": self.group.variant,
            "touched": self.swept is not None,
            "value": None if self.swept is None else self.swept.value,
            "cells": len(self.group.cells),
            "missing": self.group.absent,
        }
        numbers = zip(COLUMNS, self.values, strict=True)
        return facts | {
            c.key: {"mean": v.mean, "sd": v.sd, "difference": v.delta, "seeds": v.n}
            for c, v in numbers
        }


def lines(swept: Sequence[Swept]) -> list[Line]:
    """Return a row for each assistant and value, in the order of the spec. An assistant that the
    setting does not touch has one row: its cells are the same for every value.
    """
    by_value = [{group.assistant: group for group in point.frame.groups} for point in swept]
    assistants = dict.fromkeys(assistant for groups in by_value for assistant in groups)
    result = []
    for assistant in assistants:
        # The setting does not touch an assistant whose cells are the same for every value.
        keys = [
            frozenset(cell.key for cell in point.frame.order if row_of(cell) == assistant)
            for point in swept
        ]
        untouched = len(set(keys)) == 1
        points = list(zip(swept, by_value, strict=True))
        if untouched:
            points = points[:1]
        for point, groups in points:
            if assistant not in groups:
                continue
            task, method, _ = assistant
            alone = groups.get((task, REFERENCE, "full"))
            reference = None
            if alone is not None and method != REFERENCE:
                reference = alone.cells
            result.append(Line(groups[assistant], None if untouched else point, reference))

    # A value may lack cells of a task, but the rows of a task stay together.
    tasks = list(dict.fromkeys(line.group.task for line in result))
    return sorted(result, key=lambda line: tasks.index(line.group.task))


def combined(key: str, swept: Sequence[Swept]) -> Frame:
    """Join the cells of all values, each once. A missing cell that not all values ask for is
    labelled with its value.
    """
    tables: list[CellTable] = []
    missing: dict[str, Missing] = {}
    order: dict[str, RecordedCell] = {}
    known: set[str] = set()
    for point in swept:
        order |= {cell.key: cell for cell in point.frame.order}
        new = [place for place, cell in enumerate(point.frame.cells) if cell.key not in known]
        tables.append(point.frame.cells.choose(new))
        known |= {cell.key for cell in point.frame.cells}
        for gap in point.frame.missing:
            label = gap.label
            if not all(_asks_for(other, gap.key) for other in swept):
                label = f"{label} [{key}={point.text}]"
            missing[gap.key] = replace(gap, label=label)
    return Frame(CellTable.joined(tables), tuple(missing.values()), tuple(order.values()))


def _asks_for(swept: Swept, key: str) -> bool:
    return any(cell.key == key for cell in swept.frame.order)


@dataclass(frozen=True)
class SweepReport:
    """The report of a sweep over the values of one setting."""

    name: str
    spec: str
    key: str
    swept: tuple[Swept, ...]
    damaged: tuple[str, ...] = ()  # records that do not read
    # what was published or left out, and what else a reader of the table has to know
    remarks: tuple[str, ...] = ()

    @cached_property
    def frame(self) -> Frame:
        """The cells of all values, each once."""
        return combined(self.key, self.swept)

    @property
    def missing(self) -> tuple[Missing, ...]:
        """The cells that are missing, each once."""
        return self.frame.missing

    @cached_property
    def table(self) -> Table:
        """The table of the sweep: a row for each task, method and value."""
        rows_of = lines(self.swept)
        rows = [Row((*main.labels_of(line.group), line.text), line.values) for line in rows_of]
        notes = (spread_note(self.frame.cells), *main.missing_notes(self.frame), CHOICE)
        meanings = [main.MEANINGS[0]]
        if any(line.reference is not None for line in rows_of):
            meanings.append(DIFFERENCE)
        if any(line.swept is None for line in rows_of):
            meanings.append(UNTOUCHED_NOTE)
        return Table(
            "sweep",
            f"Values of {self.key}",
            ("Task", "Method", self.key),
            COLUMNS,
            tuple(rows),
            notes,
            tuple(meanings),
        )

    def terminal(self, console: Console) -> None:
        """Print the table, the remarks and what is missing."""
        console.print(terminal(self.table, console.width))
        for fact in self.remarks:
            console.print(Text(fact), soft_wrap=True)
        name_missing(console, self.missing)

    def write(self, folder: Path) -> list[Path]:
        """Write `report.md` and the table in every format to a folder; return the files."""
        make_own(folder)
        return write_pages(folder, {"report.md": self.markdown()}, [self.table])

    def markdown(self) -> str:
        """Return the page as Markdown: what was swept, missing cells, and the table."""
        values = ", ".join(f"`{point.text}`" for point in self.swept)
        facts = [
            f"Spec `{self.spec}`, `{self.key}` = {values}.",
            f"{len(self.frame.cells)} of {len(self.frame.order)} different cells, "
            f"{self.frame.cells.counts.sum()} episodes.",
            *map(markdown_text, (*self.remarks, *self.damaged)),
        ]
        parts = [f"# Sweep: {self.name}\n", "".join(f"- {fact}\n" for fact in facts)]
        if self.missing:
            lines = "".join(
                f"- {markdown_text(f'{cell.label}: {cell.reason}')}\n" for cell in self.missing
            )
            parts.append(f"## Missing cells\n\n{lines}")
        return "\n".join([*parts, markdown(self.table)])

    def as_json(self) -> dict[str, Any]:
        """Return the report as JSON values: name, spec, setting, its values, the rows, remarks and
        missing cells.
        """
        return {
            "name": self.name,
            "spec": self.spec,
            "setting": self.key,
            "values": [point.value for point in self.swept],
            "rows": [line.as_json() for line in lines(self.swept)],
            "remarks": [*self.remarks],
            "missing": [{"cell": gap.label, "reason": gap.reason} for gap in self.missing],
        }


def report_sweep(sweep: Sweep, values: Sequence[Asked]) -> SweepReport:
    """Report a sweep. `values` are what each of its values asks for, in their order."""
    swept: list[Swept] = []
    damaged: list[str] = []
    remarks: list[str] = []
    for point, asked in zip(sweep.points, values, strict=True):
        # A sweep reports neither trained parts nor branches.
        cells = tuple(replace(cell, branches=None) for cell in asked.cells)
        report = report_run(replace(asked, cells=cells, parts=()))
        damaged += report.damaged
        remarks += [
            f"{sweep.key} = {point.text}: {fact}" for fact in (*report.published, *report.remarks)
        ]
        swept.append(Swept(point.text, point.value, report.frame))
    return SweepReport(
        sweep.name,
        sweep.spec,
        sweep.key,
        tuple(swept),
        tuple(dict.fromkeys(damaged)),
        tuple(remarks),
    )
