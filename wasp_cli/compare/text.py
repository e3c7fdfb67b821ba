"""Two runs side by side in words: for the terminal, as Markdown with its tables, and for
machines.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from wasp_cli.cells.asked import Asked
from wasp_cli.compare import LEVEL, Compared, State
from wasp_cli.compare.paired import MEASURES
from wasp_cli.errors import first
from wasp_cli.report.bootstrap import Estimate
from wasp_cli.report.explain.facts import plain_values
from wasp_cli.report.render import RENDERERS, markdown, markdown_text, terminal, write_pages
from wasp_cli.report.summary import UNDEFINED, Value
from wasp_cli.report.tables import Row, Table, task_title, who_title
from wasp_cli.report.tables.main import PAPER_COLUMNS

PAGE = "compare.md"
TITLE = "# Comparison\n"
SHOWN = 12  # cells that a terminal names of each kind
OPTIONAL = ("viol", "int_rate")
COLUMNS = tuple(
    replace(
        next(column for column in PAPER_COLUMNS if column.key == name),
        better=None,
        signed=True,
        optional=name in OPTIONAL,
    )
    for name in MEASURES
)
STATES: dict[State, str] = {
    "same": "the same",
    "same rows": "the same rows under another key",
    "differs": "other rows",
    "not compared": "not compared",
    "only first": "in the first only",
    "only second": "in the second only",
}
MEANINGS = (
    "Differences are second minus first, as means over the episodes, with 95 % intervals "
    "over worlds.",
    f"More than noise: p at most {LEVEL:g}, from flipping the signs of the worlds' "
    "differences, corrected for the number of measures and "
    "of cells that differ. Noise is chance over worlds: what another training of the same "
    "spec would move is not in it.",
)


def headline(compared: Compared) -> str:
    """Return one sentence: how many cells are in which state, and how many differ by more than
    noise.
    """
    counts = [(words, len(compared.having(state))) for state, words in STATES.items()]
    counted = ", ".join(f"{count} {words}" for words, count in counts if count) or "none"
    beyond = len(compared.beyond)
    return (
        f"{_cells(len(compared.cells))}: {counted}; {beyond or 'none'} "
        f"{'differs' if beyond == 1 else 'differ'} by more than noise."
    )


def cells_table(compared: Compared) -> Table:
    """Return the cells that differ, a row each, those with the smallest p-value first."""
    rows = []
    for cell in sorted(compared.having("differs"), key=lambda cell: min(cell.p.values())):
        beyond = ", ".join(column.title for column in COLUMNS if column.key in cell.beyond) or "-"
        rows.append(
            Row((cell.label, beyond), _values(cell.paired.differences if cell.paired else {}, 1))
        )
    labels, notes = ("Cell", "More than noise"), tuple(_unable(compared))
    return Table(
        "cells",
        "Cells that differ",
        labels,
        COLUMNS,
        tuple(rows),
        notes,
        MEANINGS,
        grouping=0,
        ranked=False,
    )


def summary_table(compared: Compared) -> Table:
    """Return the assistants of which cells differ, a row each."""
    rows = []
    for assistant in compared.summary:
        if assistant.differing:
            name = who_title(assistant.method, assistant.variant)
            labels = (
                task_title(assistant.task),
                name,
                f"{assistant.differing} of {assistant.cells}",
            )
            rows.append(Row(labels, _values(assistant.estimates)))
    meanings = (
        "Second minus first over all cells that both have, with a 95 % interval over "
        "trainings: of one over its worlds, of two or three "
        "no more than their range. Viol. and Int. pool the episodes of a cell, so long "
        "ones weigh more than in the table of cells.",
    )
    labels = ("Task", "Method", "Cells")
    return Table(
        "summary",
        "Difference of each assistant",
        labels,
        COLUMNS,
        tuple(rows),
        (),
        meanings,
        ranked=False,
    )


def tables(compared: Compared) -> list[Table]:
    """Return the tables of a comparison that have rows."""
    return [table for table in (cells_table(compared), summary_table(compared)) if table.rows]


def _values(numbers: Mapping[str, Estimate | None], seeds: int = 0) -> tuple[Value, ...]:
    row = (numbers.get(column.key) for column in COLUMNS)
    return tuple(
        UNDEFINED
        if each is None
        else Value(each.value, n=seeds, ranked=False, interval=each.interval)
        for each in row
    )


def _unable(compared: Compared) -> Iterator[str]:
    paired = [cell.paired for cell in compared.having("differs") if cell.paired is not None]
    partly = sum(each.worlds < max(each.episodes) for each in paired)
    if partly:
        yield f"{_cells(partly)} with other worlds too: those in common are compared."
    weak = sum(each.least * len(paired) > LEVEL for each in paired)
    if weak:
        yield (
            f"Too few episodes in {weak} of {_cells(len(paired))} to differ by more than "
            "noise among so many, whatever the difference: "
            "look at the difference of each assistant."
        )


def remarks(compared: Compared, shown: int = SHOWN) -> Iterator[str]:
    """Yield what stands before the tables, a line each; at most `shown` cells of a kind."""
    yield f"{_named(compared.first)} and {_named(compared.second)}"
    yield headline(compared)
    yield from (
        f"  {line}" for line in dict.fromkeys((*compared.first.absent, *compared.second.absent))
    )
    for state in ("only first", "only second", "not compared"):
        cells = compared.having(state)
        yield from first(
            [
                f"  {STATES[state]}: {cell.label}{f' ({cell.reason})' if cell.reason else ''}"
                for cell in cells
            ],
            shown,
        )
    if compared.causes:
        yield "What differs behind the cells:"
        yield from first(
            [f"  {cause} ({_cells(count)})" for cause, count in compared.causes], shown
        )
    odd = [cell for cell in compared.having("differs") if cell.keys[0] == cell.keys[1]]
    if odd:
        what = "cell has other rows" if len(odd) == 1 else "cells have other rows"
        yield (
            f"{len(odd)} {what} under the same key: computed on another machine, or the file "
            f"was changed since: {odd[0].label}"
        )


def _cells(count: int) -> str:
    return "1 cell" if count == 1 else f"{count} cells"


def _named(side: Asked) -> str:
    return f"{side.spec.name} in {side.layout.root} (run {side.run_id})"


def show(compared: Compared, console: Console) -> None:
    """Print a comparison: at most SHOWN cells of a kind."""
    for line in remarks(compared):
        console.print(Text(line), soft_wrap=True)
    for table in tables(compared):
        rows = table.rows[:SHOWN] if table.name == "cells" else table.rows
        console.print(terminal(replace(table, rows=rows), console.width))
        if len(rows) < len(table.rows):
            console.print(
                Text(f"and {len(table.rows) - len(rows)} more; --out DIR writes all"),
                soft_wrap=True,
            )


def page(compared: Sequence[Compared]) -> str:
    """Return comparisons as one page of Markdown, with all cells."""
    parts = [TITLE]
    for each in compared:
        lines = (f"- {markdown_text(line.strip())}\n" for line in remarks(each, shown=sys.maxsize))
        parts.append(f"## {each.first.spec.name}\n\n{''.join(lines)}")
        parts += [
            markdown(replace(table, title=f"{each.first.spec.name}: {table.title}"))
            for table in tables(each)
        ]
    return "\n".join(parts)


def write(compared: Sequence[Compared], folder: Path) -> list[Path]:
    """Write comparisons into a folder: the page `compare.md` and the data files of each table.
    Files of an earlier comparison there are removed. Returns what was written.

    Raises:
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    before = ""
    if (folder / PAGE).is_file():
        before = (folder / PAGE).read_text("utf-8", "replace")
    named = [
        replace(table, name=f"{each.first.spec.name}-{table.name}")
        for each in compared
        for table in tables(each)
    ]
    written = write_pages(folder, {PAGE: page(compared)}, named)

    # Tables of the specs that the page before was about would pass for a part of this one.
    specs = re.findall(r"^## (.+)$", before, re.MULTILINE) if before.startswith(TITLE) else []
    old = {
        f"{spec}-{table}.{ending}"
        for spec in specs
        for table in ("cells", "summary")
        for ending in RENDERERS
    }
    for path in {path for path in folder.iterdir() if path.name in old} - {*written}:
        path.unlink()
    return written


def as_json(compared: Compared) -> dict[str, Any]:
    """Return a comparison as values that JSON can hold, with every cell."""
    sides = {
        name: {
            "folder": str(side.layout.root),
            "spec": side.spec.name,
            "run": side.run_id,
            "absent": side.absent,
        }
        for name, side in (("first", compared.first), ("second", compared.second))
    }
    cells = [{**asdict(cell), "beyond": list(cell.beyond)} for cell in compared.cells]
    facts = {
        **sides,
        "alike": compared.alike,
        "causes": dict(compared.causes),
        "cells": cells,
        "summary": [*map(asdict, compared.summary)],
    }
    return dict(plain_values(facts))
