"""The legend of every figure lies within it, whatever the number of tasks and of methods."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from tests.report.swept import NUMBERS, invent_sweep
from wasp_cli.methods.registry import METHODS
from wasp_cli.report import axis_figures as by_axis
from wasp_cli.report import figures as methods
from wasp_cli.report.stats import Frame

ROWS = [name for name, info in METHODS.items() if info.impaired][:9]
TASKS = ("goal1", "formula1", "race1")
Drawing = Callable[[Frame, Path], list[Path]]


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that would have been written."""
    found: list[Figure] = []

    def kept(figure: Figure, folder: Path, name: str) -> list[Path]:
        figure.draw_without_rendering()
        found.append(figure)
        return []

    for module in (by_axis, methods):
        monkeypatch.setattr(module, "figure_files", kept)
    return found


def of(frame: Frame, tasks: int, rows: int) -> Frame:
    """The numbers of one cell for each operator, under so many tasks and methods."""
    cells = [cell for cell in frame.cells if cell.identity.method == "ida" and cell.identity.seed == 0]
    named = product(TASKS[:tasks], ROWS[:rows], cells)
    return Frame(tuple(replace(cell, identity=replace(cell.identity, task=task, method=method)) for task, method, cell in named))


def faults(figure: Figure, entries: int) -> list[str]:
    """What is wrong with a legend of so many entries."""
    (shown,) = figure.legends
    box, page = shown.get_window_extent(), figure.bbox
    within = page.x0 <= box.x0 < box.x1 <= page.x1 and page.y0 <= box.y0 < box.y1 <= page.y1
    panels = [panel.get_window_extent() for panel in figure.axes]
    found = {
        "entries are missing": len(shown.get_texts()) != entries,
        "the legend is cut": not within,
        "the legend hides a panel": any(box.overlaps(panel) for panel in panels),
        "the legend leaves no room for a panel": any(panel.height <= 60 for panel in panels),
    }
    return [fault for fault, there in found.items() if there]


@pytest.mark.parametrize(("tasks", "rows"), [(1, 9), (3, 5)])
@pytest.mark.parametrize("draw", [by_axis.severity_figure, methods.cost_return_figure])
def test_the_legend_of_the_methods_is_whole(frame: Frame, figures: list[Figure], draw: Drawing, tasks: int, rows: int) -> None:
    draw(of(frame, tasks, rows), Path())
    assert faults(figures[0], rows) == []


@pytest.mark.parametrize("conditions", [1, by_axis.MOST])
def test_the_legend_of_a_sweep_is_whole(tmp_path: Path, conditions: int) -> None:
    operators = [("limited-skill", 0.1 + 0.1 * number) for number in range(conditions)]
    figure = by_axis.sweep_figure("diffusion.ratio", invent_sweep(tmp_path, NUMBERS, operators, (0,)), "goal1")
    figure.draw_without_rendering()
    assert faults(figure, conditions + 1) == []
