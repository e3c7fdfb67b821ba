"""Print the tables of the environments in specs/away from the published rows, beside what WASP
changes in the same episodes. Nothing is computed anew, and none of the environments has to be
installed.

python docs/examples/away.py
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from wasp_cli.cells.cell import stored_cells
from wasp_cli.cells.read import read_cells
from wasp_cli.cells.table import CellTable
from wasp_cli.report.bootstrap import contrast_of
from wasp_cli.report.summary import summarise
from wasp_cli.store.layout import Layout

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "results" / "published"
TASKS = ("LunarLander", "PointMaze", "TakeCover", "Racetrack", "CarRacing")
METHODS = {
    "human": "Human-only",
    "ida": "IDA",
    "diffusion": "Diffusion",
    "wasp": "WASP",
    "expert": "Expert (reference)",
}
# of each column: the measure, by what it is multiplied, and its digits
COLUMNS = {
    "Return ↑": ("return", 1, 1),
    "Succ. (%) ↑": ("success", 100, 1),
    "Cost ↓": ("cost", 1, 2),
    "Cost/1000 ↓": ("viol_env", 1000, 1),
    "Int. ↓": ("int_rate", 1, 2),
}


@cache
def published_cells(folder: Path = PUBLISHED) -> CellTable:
    """Return the published cells of the environments and of the methods above."""
    layout = Layout(folder)
    shown = [cell for cell in stored_cells(layout) if cell.task in TASKS and cell.method in METHODS]
    return read_cells(layout, shown).table


def cells_of(task: str, folder: Path = PUBLISHED) -> CellTable:
    """Return the cells of a task; none where none is published."""
    return published_cells(folder).where(lambda cell: cell.task == task)


def of_method(cells: CellTable, method: str) -> CellTable:
    """Return the cells of a method."""
    return cells.where(lambda cell: cell.method == method)


def heading(cells: CellTable) -> list[str]:
    """Return the names of the table's columns; success only where an episode can succeed."""
    succeeds = cells.episodes("success").any()
    return [name for name in COLUMNS if succeeds or name != "Succ. (%) ↑"]


def table(cells: CellTable, *, spread: bool = True) -> list[list[str]]:
    """Return the rows of a task's table as a report has them: the means of the cells, and the
    standard deviation over trainings where there are several.
    """
    rows = []
    for method, label in METHODS.items():
        own = of_method(cells, method)
        if not len(own):
            continue
        row = [label]
        for name in heading(cells):
            measure, scale, digits = COLUMNS[name]
            value = summarise(own, measure)
            text = f"{scale * value.mean:.{digits}f}"
            if spread and value.sd is not None:
                text = f"{text} ± {scale * value.sd:.{digits}f}"
            row.append(text)
        rows.append(row)
    return rows


def differences(cells: CellTable) -> list[list[str]]:
    """Return WASP minus each other method in the same episodes: return and cost, each with its
    95 % interval over worlds; over trainings and worlds where there are several trainings.
    """
    wasp = of_method(cells, "wasp")
    rows = []
    for method, label in METHODS.items():
        if method not in ("wasp", "expert"):
            other = of_method(cells, method)
            numbers = [with_interval(wasp, other, measure) for measure in ("return", "cost")]
            rows.append([f"WASP - {label}", *numbers])
    return rows


def with_interval(cells: CellTable, other: CellTable, measure: str) -> str:
    """Return the mean of paired differences and its 95 % interval, as a text."""
    contrast = contrast_of(cells, other, measure)
    if contrast is None or contrast.bootstrap is None:
        return "n/a"
    low, high = contrast.bootstrap
    return f"{contrast.value:+.2f} [{low:.2f}, {high:.2f}]"


def markdown(first: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [f"| {first} | {' | '.join(columns)} |", f"| --- |{' ---: |' * len(columns)}"]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join(lines)


def report(task: str, folder: Path = PUBLISHED) -> str | None:
    """Return both tables of a task, or None where no episode of it is published."""
    cells = cells_of(task, folder)
    if not len(cells):
        return None
    first = markdown(task, heading(cells), table(cells))
    second = markdown("in the same episodes", ["return", "cost"], differences(cells))
    return f"{first}\n\n{second}"


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else PUBLISHED
    for name in TASKS:
        text = report(name, folder)
        print(f"{name}: nothing is published\n" if text is None else f"{text}\n")
