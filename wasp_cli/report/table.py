"""One table as a value: what stands in it, apart from how it is printed; and as text: Markdown, CSV, a terminal.

A renderer is a function from a `Table`; `render.RENDERERS` has those that write a file, by file ending.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from rich import box
from rich.console import Group
from rich.markup import escape
from rich.table import Table as RichTable
from rich.text import Text

if TYPE_CHECKING:
    from wasp_cli.report.bootstrap import Interval

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
    interval: Interval | None = None
    """Where the mean may lie, and what says so."""


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
    """Whether ± and the interval are printed; data files have them anyway."""
    optional: bool = False
    """Left out where there is no room."""
    signed: bool = False
    """Whether a positive number has a sign: a difference."""

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
        """`mean ± sd [low, high] (difference)`."""
        if value.mean is None:
            return MISSING
        text = self.number(value.mean, self.signed)
        if value.sd is not None and self.spread and spread:
            text += f" ± {self.number(value.sd)}"
        if value.interval is not None and self.spread and spread:
            text += f" [{self.number(value.interval.low, self.signed)}, {self.number(value.interval.high, self.signed)}]"
        if value.delta is not None and delta:
            text += f" ({self.number(value.delta, sign=True)})"
        return text


@dataclass(frozen=True)
class Row:
    """Labels, then one value per column."""

    labels: tuple[str, ...]
    values: tuple[Value, ...]
    columns: tuple[Column, ...] = ()
    """How its numbers are printed and ranked, where rows have different units; otherwise as the table's columns say."""
    names: tuple[str, ...] = ()
    """Its labels in data files, where they are others: numbers have no unit there."""


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
    seconds: frozenset[tuple[int, int]] = field(init=False, compare=False)
    """(row, column) of the second best ones, where something is behind them."""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row.labels) != len(self.labels) or {len(row.values), len(row.columns or self.columns)} != {len(self.columns)}:
                raise ValueError(f"row {row.labels} does not fit the columns of table {self.name}")
        placed = list(self._places()) if self.ranked else []
        object.__setattr__(self, "marks", frozenset(where for where, place, last in placed if place == 0 and last > 0))
        object.__setattr__(self, "seconds", frozenset(where for where, place, last in placed if place == 1 and last > 1))

    def group(self, row: int) -> tuple[str, ...]:
        """What a row is compared within."""
        return self.rows[row].labels[: self.grouping] if self.grouped else ()

    def starts_group(self, row: int) -> bool:
        """Whether a row is the first of its group."""
        return row == 0 or self.group(row) != self.group(row - 1)

    def text(self, row: int, column: int, spread: bool = True, delta: bool = True) -> str:
        """A value as it is printed."""
        return self._column(row, column).cell(self.rows[row].values[column], spread, delta)

    def shown_labels(self, row: int) -> list[str]:
        """The labels of a row as people read them: a group is named once."""
        labels = list(self.rows[row].labels)
        if self.grouped and not self.starts_group(row):
            labels[: self.grouping] = [""] * self.grouping
        return labels

    def _places(self) -> Iterator[tuple[tuple[int, int], int, int]]:
        """(row, column) of every ranked value, its place in its group from 0, and the last place there.

        As printed: rows that print the same number share a place, so that nobody is best where all print the same.
        """
        for c in range(len(self.columns)):
            groups: dict[tuple[str, ...], dict[int, float]] = {}
            for r, row in enumerate(self.rows):
                value, column = row.values[c], self._column(r, c)
                if column.better is not None and value.ranked and value.mean is not None and math.isfinite(value.mean):
                    groups.setdefault(self.group(r), {})[r] = float(column.number(value.mean))
            for printed in groups.values():
                order = sorted(set(printed.values()), reverse=self._column(min(printed), c).better == "up")
                yield from (((r, c), order.index(number), len(order) - 1) for r, number in printed.items())

    def _column(self, row: int, column: int) -> Column:
        return (self.rows[row].columns or self.columns)[column]


def markdown(table: Table) -> str:
    """A Markdown section: title, table with the best values bold, notes."""

    def line(cells: list[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    lines = [f"## {table.title}", "", line([*table.labels, *(column.heading for column in table.columns)])]
    lines.append("|" + " --- |" * len(table.labels) + " ---: |" * len(table.columns))
    for r in range(len(table.rows)):
        cells = [table.text(r, c) for c in range(len(table.columns))]
        cells = [f"**{text}**" if (r, c) in table.marks else text for c, text in enumerate(cells)]
        lines.append(line([*table.shown_labels(r), *cells]))
    if table.notes or table.meanings:
        lines += ["", *(f"- {note}" for note in table.notes + table.meanings)]
    return "\n".join(lines) + "\n"


def csv_text(table: Table) -> str:
    """Unscaled numbers, one line per row; `_sd`, `_low`, `_high` and `_delta` columns where the table has any, `seeds` last."""
    parts = [_parts(row) for row in table.rows]
    shown = [("", *(name for name in PARTS[1:] if any(row[c][name] is not None for row in parts))) for c in range(len(table.columns))]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    header = [label.lower().replace(" ", "_") for label in table.labels]
    writer.writerow([*header, *(column.key + name for column, names in zip(table.columns, shown, strict=True) for name in names), "seeds"])
    for row, values in zip(table.rows, parts, strict=True):
        numbers = (plain(each[name]) for each, names in zip(values, shown, strict=True) for name in names)
        writer.writerow([*(row.names or row.labels), *numbers, max((value.n for value in row.values), default=0)])
    return out.getvalue()


PARTS = ("", "_sd", "_low", "_high", "_delta")
"""What a data file may say of a value: endings of its column's key."""


def _parts(row: Row) -> list[dict[str, float | None]]:
    """By PARTS, for each value of a row."""
    spans = ((None, None) if value.interval is None else (value.interval.low, value.interval.high) for value in row.values)
    return [
        dict(zip(PARTS, (value.mean, value.sd, *span, value.delta), strict=True)) for value, span in zip(row.values, spans, strict=True)
    ]


def plain(number: float | None) -> str | float:
    """A number in a data file, empty where it is undefined. Twelve decimals: the last bits of a sum differ between machines."""
    if number is None or not math.isfinite(number):
        return ""
    return round(number, 12) + (0.0 if isinstance(number, float) else 0)


def terminal(table: Table, width: int = 120) -> Group:
    """For a rich console of some width; best values are bold, second best underlined. What does not fit is left out, never cut off."""
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
    texts = [[table.text(r, c, spread, delta) for c in shown] for r in range(len(table.rows))]
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
        styles = ("bold green" if (r, c) in table.marks else "underline" if (r, c) in table.seconds else "" for c in shown)
        cells = [Text.assemble(pair) for pair in zip(line, styles, strict=True)]  # as a part: the blanks beside it have no style
        rich.add_row(*(Text(label) for label in table.shown_labels(r)), *cells)
    return rich, frame + sum(tight)
