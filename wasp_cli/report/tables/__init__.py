"""The tables of a report. Here one table as a value, apart from how it is printed
(`report.render`), and the names that stand in tables.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

from wasp_cli.errors import UnknownName
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.report.stats import Group
from wasp_cli.report.summary import Value
from wasp_cli.tasks.registry import TASKS

MISSING = "n/a"  # printed where a number is undefined or its cells are missing


@dataclass(frozen=True)
class Column:
    """How the numbers of a column are called, printed and ranked."""

    key: str  # name in data files
    title: str
    better: Literal["up", "down"] | None = None
    digits: int = 2
    scale: float = 1.0  # printed number per stored number: 100 for percent
    spread: bool = True  # whether ± and the interval are printed; data files have them anyway
    optional: bool = False  # left out where there is no room
    signed: bool = False  # whether a positive number has a sign: a difference
    least: bool = False
    """Whether a positive number that would be printed as zero is printed as less than the
    smallest one that is not: a time.
    """

    @property
    def heading(self) -> str:
        """The title, with an arrow where more or less is better."""
        return self.title + {"up": " ↑", "down": " ↓", None: ""}[self.better]

    def number(self, value: float | None, sign: bool = False) -> str:
        """Print one number, scaled; MISSING for None, NaN and infinity. `sign`: with a sign also
        where it is positive.
        """
        if value is None or not math.isfinite(value):
            return MISSING
        rounded = round(value * self.scale, self.digits) + 0.0
        if self.least and not rounded and value > 0:
            return f"<{10.0**-self.digits:.{self.digits}f}"
        return f"{rounded:{'+' if sign else ''}.{self.digits}f}"

    def cell(self, value: Value, spread: bool = True, delta: bool = True) -> str:
        """Print `mean ± sd [low, high] (difference)`."""
        if value.mean is None:
            return MISSING
        text = self.number(value.mean, self.signed)
        if value.sd is not None and self.spread and spread:
            text += f" ± {self.number(value.sd)}"
        if value.interval is not None and self.spread and spread:
            text += (
                f" [{self.number(value.interval.low, self.signed)}, "
                f"{self.number(value.interval.high, self.signed)}]"
            )
        if value.delta is not None and delta:
            text += f" ({self.number(value.delta, sign=True)})"
        return text


@dataclass(frozen=True)
class Row:
    """A line of a table: its labels, and a value for each column."""

    labels: tuple[str, ...]
    values: tuple[Value, ...]
    columns: tuple[Column, ...] = ()
    """How its numbers are printed and ranked, where rows have different units; otherwise as the
    table's columns say.
    """
    # its labels in data files, where they are others: numbers have no unit there
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Table:
    """Rows of values. Rows with the same first labels form a group, in which the best value of
    each column is marked.
    """

    name: str  # name of the files
    title: str
    labels: tuple[str, ...]  # headings of the label columns
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    # what a reader must know before believing a number; printed everywhere
    notes: tuple[str, ...] = ()
    meanings: tuple[str, ...] = ()  # what the columns mean; printed where there is room
    grouping: int = 1  # how many labels form a group; with 0 all rows are one
    ranked: bool = True
    # (row, column) of the best values
    marks: frozenset[tuple[int, int]] = field(init=False, compare=False)
    seconds: frozenset[tuple[int, int]] = field(init=False, compare=False)
    """(row, column) of the second best ones, where something is behind them."""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row.labels) != len(self.labels) or {
                len(row.values),
                len(row.columns or self.columns),
            } != {len(self.columns)}:
                raise ValueError(f"row {row.labels} does not fit the columns of table {self.name}")
        placed = list(self._places()) if self.ranked else []
        object.__setattr__(
            self,
            "marks",
            frozenset(where for where, place, last in placed if place == 0 and last > 0),
        )
        object.__setattr__(
            self,
            "seconds",
            frozenset(where for where, place, last in placed if place == 1 and last > 1),
        )

    def group(self, row: int) -> tuple[str, ...]:
        """Return the labels that a row shares with its group."""
        return self.rows[row].labels[: self.grouping]

    def starts_group(self, row: int) -> bool:
        """Whether a row is the first one of its group."""
        return row == 0 or self.group(row) != self.group(row - 1)

    def text(self, row: int, column: int, spread: bool = True, delta: bool = True) -> str:
        """Return a value as it is printed, with or without its spread and its difference."""
        return self._column(row, column).cell(self.rows[row].values[column], spread, delta)

    def shown_labels(self, row: int) -> list[str]:
        """Return the labels of a row as they are printed: those of its group where it is the first
        row of it, else empty.
        """
        labels = list(self.rows[row].labels)
        if not self.starts_group(row):
            labels[: self.grouping] = [""] * self.grouping
        return labels

    def _places(self) -> Iterator[tuple[tuple[int, int], int, int]]:
        """(row, column) of every ranked value, its place in its group from 0, and the last place
        there.

        As printed: rows that print the same number share a place, so that nobody is best where all
        print the same.
        """
        for c in range(len(self.columns)):
            groups: dict[tuple[str, ...], dict[int, float]] = {}
            for r, row in enumerate(self.rows):
                value = row.values[c]
                column = self._column(r, c)
                if (
                    column.better is not None
                    and value.ranked
                    and value.mean is not None
                    and math.isfinite(value.mean)
                ):
                    groups.setdefault(self.group(r), {})[r] = float(column.number(value.mean))
            for printed in groups.values():
                order = sorted(
                    set(printed.values()), reverse=self._column(min(printed), c).better == "up"
                )
                yield from (
                    ((r, c), order.index(number), len(order) - 1) for r, number in printed.items()
                )

    def _column(self, row: int, column: int) -> Column:
        return (self.rows[row].columns or self.columns)[column]


def task_title(task: str) -> str:
    """Return what a task is called; one that a spec declared may not be known here."""
    try:
        return TASKS[task].title
    except UnknownName:
        return task


def operator_title(variant: str) -> str:
    """Return what an operator is called in tables."""
    return "Unimpaired" if variant == UNIMPAIRED else OPERATORS[variant].title


def assistant_title(group: Group, *, name_full: bool = False) -> str:
    """Return the label of a row, with its ablation where it is one; an incomplete row says of
    how many cells it is the mean.
    """
    title = who_title(group.method, group.variant)
    if name_full and group.variant == "full":
        title += f", {METHODS[group.method].variants['full']}"
    if not group.complete:
        title += f" [{len(group.cells)} of {len(group.cells) + group.absent} cells]"
    return title


def who_title(method: str, variant: str = "full") -> str:
    """Return the title of a method, with that of its ablation unless it is the whole method.

    What no registry knows, of a plugin that is gone or of another version, keeps its name.
    """
    title, variants = (
        (METHODS[method].title, METHODS[method].variants) if method in METHODS else (method, {})
    )
    return title if variant == "full" else f"{title}, {variants.get(variant, variant)}"
