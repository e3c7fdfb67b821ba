"""One table as a value: what stands in it, apart from how it is printed.

A renderer is a function from a `Table`; `RENDERERS` has those that write a file, by file ending.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from rich import box
from rich.console import Group
from rich.markup import escape
from rich.table import Table as RichTable
from rich.text import Text

MISSING = "n/a"
"""Printed where a number is undefined or its cells are missing."""


@dataclass(frozen=True)
class Value:
    """A number of a table. None is undefined."""

    mean: float | None
    sd: float | None = None
    """Spread over seed-level means; None with fewer than two seeds."""
    n: int = 0
    """Seeds behind the mean."""
    delta: float | None = None
    """Difference to a reference row, where a table has one."""
    ranked: bool = True
    """Whether it may be the best of its column."""


UNDEFINED = Value(None, ranked=False)


@dataclass(frozen=True)
class Column:
    """A numeric column."""

    key: str
    """Name in data files."""
    title: str
    better: Literal["up", "down"] | None = None
    digits: int = 2
    scale: float = 1.0
    """Printed number per stored number: 100 for percent."""
    spread: bool = True
    """Whether ± is printed; data files have it anyway."""
    optional: bool = False
    """Left out where there is no room."""

    @property
    def heading(self) -> str:
        """The title with the direction in which numbers get better."""
        return self.title + {"up": " ↑", "down": " ↓", None: ""}[self.better]

    def number(self, value: float | None, sign: bool = False) -> str:
        """A printed number; no negative zero."""
        if value is None or not math.isfinite(value):
            return MISSING
        rounded = round(value * self.scale, self.digits) + 0.0
        return f"{rounded:{'+' if sign else ''}.{self.digits}f}"

    def cell(self, value: Value, spread: bool = True, delta: bool = True) -> str:
        """`mean ± sd (difference)`."""
        if value.mean is None:
            return MISSING
        text = self.number(value.mean)
        if value.sd is not None and self.spread and spread:
            text += f" ± {self.number(value.sd)}"
        if value.delta is not None and delta:
            text += f" ({self.number(value.delta, sign=True)})"
        return text


@dataclass(frozen=True)
class Row:
    """Labels, then one value per column."""

    labels: tuple[str, ...]
    values: tuple[Value, ...]


@dataclass(frozen=True)
class Table:
    """Rows of values. Rows with the same first labels form a group, in which the best value of each column is marked."""

    name: str
    """Name of the files."""
    title: str
    labels: tuple[str, ...]
    """Headings of the label columns."""
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    """What a reader must know before believing a number; printed everywhere."""
    meanings: tuple[str, ...] = ()
    """What the columns mean; printed where there is room."""
    grouped: bool = True
    """Whether labels form groups; otherwise all rows are one."""
    grouping: int = 1
    """How many labels form a group."""
    ranked: bool = True
    marks: frozenset[tuple[int, int]] = field(init=False, compare=False)
    """(row, column) of the best values."""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row.labels) != len(self.labels) or len(row.values) != len(self.columns):
                raise ValueError(f"row {row.labels} does not fit the columns of table {self.name}")
        object.__setattr__(self, "marks", frozenset(self._best()) if self.ranked else frozenset())

    def group(self, row: int) -> tuple[str, ...]:
        """What a row is compared within."""
        return self.rows[row].labels[: self.grouping] if self.grouped else ()

    def starts_group(self, row: int) -> bool:
        """Whether a row is the first of its group."""
        return row == 0 or self.group(row) != self.group(row - 1)

    def _best(self) -> set[tuple[int, int]]:
        """Best as printed: rows that print the same number share the mark, and nobody has it when all print the same."""
        best: set[tuple[int, int]] = set()
        for c, column in enumerate(self.columns):
            if column.better is None:
                continue
            groups: dict[tuple[str, ...], dict[int, float]] = {}
            for r, row in enumerate(self.rows):
                value = row.values[c]
                if value.ranked and value.mean is not None and math.isfinite(value.mean):
                    groups.setdefault(self.group(r), {})[r] = float(column.number(value.mean))
            for printed in groups.values():
                winner = max(printed.values()) if column.better == "up" else min(printed.values())
                if len(set(printed.values())) > 1:
                    best |= {(r, c) for r, number in printed.items() if number == winner}
        return best


def markdown(table: Table) -> str:
    """A Markdown section: title, table with the best values bold, notes."""

    def line(cells: list[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    lines = [f"## {table.title}", "", line([*table.labels, *(column.heading for column in table.columns)])]
    lines.append("|" + " --- |" * len(table.labels) + " ---: |" * len(table.columns))
    for r, row in enumerate(table.rows):
        cells = [column.cell(value) for column, value in zip(table.columns, row.values, strict=True)]
        cells = [f"**{text}**" if (r, c) in table.marks else text for c, text in enumerate(cells)]
        lines.append(line([*_labels(table, r), *cells]))
    if table.notes or table.meanings:
        lines += ["", *(f"- {note}" for note in table.notes + table.meanings)]
    return "\n".join(lines) + "\n"


def csv_text(table: Table) -> str:
    """Unscaled numbers, one line per row; `_sd` and `_delta` columns where the table has any, `seeds` last."""
    with_sd = [c for c in range(len(table.columns)) if any(row.values[c].sd is not None for row in table.rows)]
    with_delta = [c for c in range(len(table.columns)) if any(row.values[c].delta is not None for row in table.rows)]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    header = [label.lower().replace(" ", "_") for label in table.labels]
    for c, column in enumerate(table.columns):
        header += [column.key, *[f"{column.key}_sd"] * (c in with_sd), *[f"{column.key}_delta"] * (c in with_delta)]
    writer.writerow([*header, "seeds"])
    for row in table.rows:
        cells: list[str | float | None] = list(row.labels)
        for c, value in enumerate(row.values):
            cells += [value.mean, *[value.sd] * (c in with_sd), *[value.delta] * (c in with_delta)]
        writer.writerow([*map(_plain, cells), max((value.n for value in row.values), default=0)])
    return out.getvalue()


def _plain(cell: str | float | None) -> str | float:
    """Twelve decimals: the last bits of a sum differ between machines."""
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return ""
    return round(cell, 12) + 0.0 if isinstance(cell, float) else cell


def terminal(table: Table, width: int = 120) -> Group:
    """For a rich console of some width; the best values are bold. What does not fit is left out, never cut off."""
    notes = list(table.notes)
    every = tuple(range(len(table.columns)))
    needed = tuple(c for c in every if not table.columns[c].optional)
    attempts = ((every, True, True), (every, False, True), (needed, False, True), (needed, False, False))
    for attempt in attempts:
        rich, least = _rich(table, width, *attempt)
        if least <= width:
            break
    if attempt != attempts[0]:
        notes.append(f"{width} columns are too narrow for everything; the files have it.")
    return Group(rich, *(Text(f"- {note}", style="dim") for note in notes))


def _rich(table: Table, width: int, shown: tuple[int, ...], spread: bool, delta: bool) -> tuple[RichTable, int]:
    """A table of some columns, and the least width at which only its headings wrap."""
    texts = [[table.columns[c].cell(row.values[c], spread, delta) for c in shown] for row in table.rows]
    headings = [table.columns[c].heading for c in shown]
    labels = [max(map(len, column)) for column in zip(table.labels, *(row.labels for row in table.rows), strict=True)]
    numbers = [max(map(len, column)) for column in zip(*texts, strict=True)] or [0] * len(shown)
    loose = [max(number, len(heading)) for number, heading in zip(numbers, headings, strict=True)]
    tight = [max(number, *map(len, heading.split())) for number, heading in zip(numbers, headings, strict=True)]
    frame = sum(labels) + 2 * (len(labels) + len(shown))  # each column has a space and a rule beside it
    rich = RichTable(title=escape(table.title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    rich.padding = (0, 1, 0, 0)
    for label, size in zip(table.labels, labels, strict=True):
        rich.add_column(escape(label), width=size)
    for heading, size in zip(headings, loose if frame + sum(loose) <= width else tight, strict=True):
        rich.add_column(escape(heading), justify="right", width=size)
    for r, line in enumerate(texts):
        if r and table.grouped and table.starts_group(r):
            rich.add_section()
        cells = [Text(text, style="bold green" if (r, c) in table.marks else "") for c, text in zip(shown, line, strict=True)]
        rich.add_row(*(Text(label) for label in _labels(table, r)), *cells)
    return rich, frame + sum(tight)


def _labels(table: Table, row: int) -> list[str]:
    """The labels of a row; a group is named once."""
    labels = list(table.rows[row].labels)
    if table.grouped and not table.starts_group(row):
        labels[: table.grouping] = [""] * table.grouping
    return labels


RENDERERS: dict[str, Callable[[Table], str]] = {"md": markdown, "csv": csv_text}
"""A table as the text of a file, by its ending."""
