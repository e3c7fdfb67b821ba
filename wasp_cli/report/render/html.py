"""A table as a fragment of HTML: for a page that brings the style, and may bring a script that sorts.

    <figure class="table" id="table1">
      <table>  thead, and one tbody per group of rows
        <th scope="col" class="number" data-better="up">
        <th scope="row">, with class "again" where the row above has the same label of its group
        <td class="number" data-value="6.5">6.50 ± 0.28</td>    unscaled, as in data files; empty where it is undefined
      <ul class="notes">, <ul class="meanings">

The best value of a group stands in <strong>, the second best in <u>. All text is escaped.
"""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

from wasp_cli.report.render.text import plain
from wasp_cli.report.stats.summary import Value
from wasp_cli.report.tables.table import Column, Table


def html(table: Table) -> str:
    """A `<figure>` with the table and its notes."""
    return "\n".join(_lines(table)) + "\n"


def _lines(table: Table) -> Iterator[str]:
    yield f'<figure class="table" id="{escape(table.name)}">'
    yield "<table>"
    yield f"<caption>{escape(table.title)}</caption>"
    headings = [f'<th scope="col">{escape(label)}</th>' for label in table.labels]
    yield f"<thead><tr>{''.join(headings + [_heading(column) for column in table.columns])}</tr></thead>"
    for r in range(len(table.rows)):
        if r == 0 or (table.grouped and table.starts_group(r)):
            yield "<tbody>" if r == 0 else "</tbody>\n<tbody>"
        yield _row(table, r)
    if table.rows:
        yield "</tbody>"
    yield "</table>"
    for name, texts in (("notes", table.notes), ("meanings", table.meanings)):
        if texts:
            yield f'<ul class="{name}">'
            yield from (f"<li>{escape(text)}</li>" for text in texts)
            yield "</ul>"
    yield "</figure>"


def _heading(column: Column) -> str:
    better = "" if column.better is None else f' data-better="{column.better}"'
    return f'<th scope="col" class="number"{better}>{escape(column.heading)}</th>'


def _row(table: Table, r: int) -> str:
    """Every row has all its labels: a sorted table would not be understood without."""
    row = table.rows[r]
    shown = table.shown_labels(r)
    cells = [f'<th scope="row"{"" if seen == label else AGAIN}>{escape(label)}</th>' for label, seen in zip(row.labels, shown, strict=True)]
    for c, value in enumerate(row.values):
        mark = "strong" if (r, c) in table.marks else "u" if (r, c) in table.seconds else None
        text = escape(table.text(r, c))
        text = text if mark is None else f"<{mark}>{text}</{mark}>"
        cells.append(f'<td class="number" data-value="{plain(value.mean)}"{_span(value)}>{text}</td>')
    return f"<tr>{''.join(cells)}</tr>"


AGAIN = ' class="again"'


def _span(value: Value) -> str:
    """The interval for machines, and what it resamples for people."""
    if value.interval is None:
        return ""
    low, high, unit, clusters = value.interval.low, value.interval.high, value.interval.unit, value.interval.clusters
    return f' data-low="{plain(low)}" data-high="{plain(high)}" title="95 % interval over {clusters} {unit}s"'
