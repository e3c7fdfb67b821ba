"""A table as text: Markdown, CSV, and for a terminal."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable
from typing import Any

from rich import box
from rich.console import Group
from rich.markup import escape
from rich.table import Table as RichTable
from rich.text import Text

from wasp_cli.report.tables.table import Row, Table


def markdown_row(cells: Iterable[object]) -> str:
    """Write a row of a Markdown table, each cell on one line; what would end a cell is escaped."""
    return "| " + " | ".join(" ".join(str(cell).split()).replace("|", "\\|") for cell in cells) + " |"


def markdown_text(text: str) -> str:
    """Write what somebody has written so that Markdown shows it as it is: no HTML, no link, no picture."""
    return re.sub(r"([\\\[\]])", r"\\\1", text).replace("&", "&amp;").replace("<", "&lt;")


def markdown(table: Table) -> str:
    """Render a Markdown section: title, table with the best values bold, notes."""
    lines = [f"## {table.title}", "", markdown_row([*table.labels, *(column.heading for column in table.columns)])]
    lines.append("|" + " --- |" * len(table.labels) + " ---: |" * len(table.columns))
    for r in range(len(table.rows)):
        cells = [table.text(r, c) for c in range(len(table.columns))]
        cells = [f"**{text}**" if (r, c) in table.marks else text for c, text in enumerate(cells)]
        lines.append(markdown_row([*table.shown_labels(r), *cells]))
    if table.notes or table.meanings:
        lines += ["", *(f"- {note}" for note in table.notes + table.meanings)]
    return "\n".join(lines) + "\n"


def csv_text(table: Table) -> str:
    """Render CSV: unscaled numbers, a line per row; `_sd`, `_low`, `_high` and `_delta` columns where the table has any, `seeds` last."""
    columns = data_columns(table)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    labels = len(table.labels)
    for row in zip(*columns.values(), strict=True):
        writer.writerow([*row[:labels], *(plain(number) for number in row[labels:-1]), row[-1]])
    return out.getvalue()


def data_columns(table: Table) -> dict[str, list[Any]]:
    """Return the columns of a data file by name: labels as texts, unscaled numbers, None where they are undefined; `seeds` last."""
    parts = [_parts(row) for row in table.rows]
    columns: dict[str, list[Any]] = {}
    for i, label in enumerate(table.labels):
        columns[label.lower().replace(" ", "_")] = [(row.names or row.labels)[i] for row in table.rows]
    for c, column in enumerate(table.columns):
        for name in ("", *(name for name in PARTS[1:] if any(row[c][name] is not None for row in parts))):
            columns[column.key + name] = [row[c][name] for row in parts]
    columns["seeds"] = [max((value.n for value in row.values), default=0) for row in table.rows]
    return columns


PARTS = ("", "_sd", "_low", "_high", "_delta")
"""What a data file may say of a value: endings of its column's key."""


def _parts(row: Row) -> list[dict[str, float | None]]:
    """By PARTS, for each value of a row."""
    spans = ((None, None) if value.interval is None else (value.interval.low, value.interval.high) for value in row.values)
    return [
        dict(zip(PARTS, (value.mean, value.sd, *span, value.delta), strict=True)) for value, span in zip(row.values, spans, strict=True)
    ]


def plain(number: float | None) -> str | float:
    """Return a number for a data file, empty where it is undefined. Twelve decimals: the last bits of a sum differ between machines."""
    if number is None or not math.isfinite(number):
        return ""
    return round(number, 12) + (0.0 if isinstance(number, float) else 0)


def terminal(table: Table, width: int = 120) -> Group:
    """Render for a console of `width` characters; best values are bold, second best underlined.

    What does not fit is left out: spreads, then optional columns from the last one on, then brackets.
    """
    notes = list(table.notes)
    every = tuple(range(len(table.columns)))
    needed = tuple(c for c in every if not table.columns[c].optional)
    spare = [c for c in every if table.columns[c].optional]
    fewer = (tuple(c for c in every if c in needed or c in spare[:kept]) for kept in range(len(spare), -1, -1))
    attempts = ((every, True, True), *((shown, False, True) for shown in fewer), (needed, False, False))
    for attempt in attempts:
        rich, least = _rich(table, width, *attempt)
        if least <= width:
            break
    shown, *parts = attempt
    cut = any(table.text(r, c, *parts) != table.text(r, c) for r in range(len(table.rows)) for c in shown)
    hidden = " and ".join(["columns"] * (len(shown) < len(every)) + ["spreads and brackets"] * cut)
    if hidden:
        notes.append(f"{hidden[0].upper()}{hidden[1:]} hidden; widen the terminal, or see the files.")
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
    fits = frame + sum(tight) <= width
    for label, size in zip(table.labels, labels, strict=True):
        rich.add_column(escape(label), width=size if fits else None)  # a label may wrap, a number may not
    for heading, size in zip(headings, loose if frame + sum(loose) <= width else tight, strict=True):
        rich.add_column(escape(heading), justify="right", width=size)
    for r, line in enumerate(texts):
        if r and table.grouped and table.starts_group(r):
            rich.add_section()
        styles = ("bold green" if (r, c) in table.marks else "underline" if (r, c) in table.seconds else "" for c in shown)
        cells = [Text.assemble(pair) for pair in zip(line, styles, strict=True)]  # as a part: the blanks beside it have no style
        rich.add_row(*(Text(label) for label in table.shown_labels(r)), *cells)
    return rich, frame + sum(tight)
