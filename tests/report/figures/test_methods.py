"""Figures of methods, and of methods along the severities."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from tests.report.invented import Grid
from tests.report.made import NO_CELLS, frame_of_tables, renamed, singles
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.methods.registry import METHODS
from wasp_cli.report import figures as methods
from wasp_cli.report.figures import cost_return_figure, profile, profile_figure, severity_figure
from wasp_cli.report.stats import Frame
from wasp_cli.report.styles import PALETTE, STYLES, style_of


def test_shows_every_method_in_its_colour(frame: Frame, tmp_path: Path) -> None:
    png, svg = cost_return_figure(frame, tmp_path)
    texts = [path.read_text(encoding="utf-8") for path in (svg, profile_figure(frame, tmp_path)[1])]
    methods = {cell.method for cell in frame.cells}
    assert methods == {"human", "ida", "diffusion", "saferl", "wasp", "expert"}
    assert all(METHODS[method].title in text for method in methods for text in texts)
    pixels = {
        tuple(pixel) for pixel in np.asarray(Image.open(png).convert("RGB")).reshape(-1, 3).tolist()
    }
    for method in methods:
        colour = STYLES[method][0]
        assert tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5)) in pixels


def test_an_assistant_from_a_file_of_ones_own_is_drawn_too(frame: Frame, tmp_path: Path) -> None:
    ida = frame.cells.where(lambda cell: cell.method == "ida")
    own = renamed(ida, lambda _: {"method": "halfway:Halfway"})
    for draw in (cost_return_figure, profile_figure):
        _, svg = draw(frame_of_tables(frame.cells, own), tmp_path)
        assert "Halfway (halfway)" in svg.read_text(encoding="utf-8"), (
            "others may have a class of that name"
        )


def test_methods_differ_in_colour_and_marker() -> None:
    assert len({style_of("a:A"), style_of("b:B"), *STYLES.values()}) == 2 + len(STYLES)
    first = list(STYLES.values())[: len(PALETTE)]
    assert (
        len({colour for colour, _ in first}) == len({marker for _, marker in first}) == len(first)
    )


def test_a_profile_is_the_share_of_episodes_on_the_better_side(frame: Frame) -> None:
    for group in frame.groups:
        for key, at_least in (("return", True), ("cost", False)):
            x, share = profile(group, key, at_least=at_least)
            for value in x:
                met = [
                    np.mean(
                        cell.episodes(key) >= value if at_least else cell.episodes(key) <= value
                    )
                    for cell in singles(group.cells)
                ]
                # Equal values make a step: the curve meets the share at one end of it.
                ends = share[x == value]
                assert np.isclose(ends.max(), np.mean(met))


def test_every_operator_with_its_severities_and_every_method(frame: Frame, tmp_path: Path) -> None:
    severity = severity_figure(frame, tmp_path)[1].read_text(encoding="utf-8")
    for text in (
        "Noisy 0.2",
        "Noisy 0.6",
        "Laggy 0.5",
        "Laggy 0.85",
        "Goal1: Return",
        "Goal1: Cost",
        "Goal1: Int.",
        "Human-only",
        "WASP",
    ):
        assert text in severity
    assert "Expert" not in severity  # it has no severity


def test_severities_that_trainings_chose_stand_under_their_name(
    frame: Frame, tmp_path: Path
) -> None:
    def chosen(cell: RecordedCell) -> dict[str, Any]:
        if (cell.operator, cell.value) != ("noisy", 0.6):
            return {}
        return {"value": 0.6 + 0.01 * cell.seed, "severity": "chosen"}

    cells = renamed(frame.cells, chosen)
    assert len({cell.value for cell in cells if cell.severity == "chosen"}) > 1
    text = severity_figure(frame_of_tables(cells), tmp_path)[1].read_text(encoding="utf-8")
    assert "Noisy chosen" in text
    assert "Noisy 0.2" in text
    assert "Noisy 0.6" not in text


def test_one_severity_an_operator_is_no_curve(grid: Callable[..., Grid], tmp_path: Path) -> None:
    one = grid(seeds=(0,)).of(lambda cell: cell.value in (0.2, 0.5))
    assert {cell.operator for cell in one.cells} == {"noisy", "laggy"}
    assert severity_figure(one.read(), tmp_path) == []
    assert (
        severity_figure(Frame(NO_CELLS), tmp_path)
        == cost_return_figure(Frame(NO_CELLS), tmp_path)
        == []
    )


# The legend of every figure lies within it, whatever the number of tasks and of methods.


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

    monkeypatch.setattr(methods, "figure_files", kept)
    return found


def of(frame: Frame, tasks: int, rows: int) -> Frame:
    """The numbers of one cell for each operator, under so many tasks and methods."""
    cells = frame.cells.where(lambda cell: cell.method == "ida" and cell.seed == 0)
    named = [
        renamed(cells, lambda _, task=task, method=method: {"task": task, "method": method})
        for task, method in product(TASKS[:tasks], ROWS[:rows])
    ]
    return frame_of_tables(*named)


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
@pytest.mark.parametrize("draw", [severity_figure, cost_return_figure])
def test_the_legend_of_the_methods_is_whole(
    frame: Frame, figures: list[Figure], draw: Drawing, tasks: int, rows: int
) -> None:
    draw(of(frame, tasks, rows), Path())
    assert faults(figures[0], rows) == []


# A figure is there whole or not at all, whenever the process that draws it is killed.


DRAW = """
import os, signal, sys
from pathlib import Path
from matplotlib.figure import Figure
from wasp_cli.report.figures import drawn, figure_files

real, left = Figure.savefig, int(sys.argv[2])

def killed(self, file, **options):
    global left
    if left == 0:
        (file if hasattr(file, "write") else open(file, "wb")).write(b"begun")
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    real(self, file, **options)

Figure.savefig = killed
with drawn((2, 2)) as figure:
    figure.subplots().plot([1, 2])
    figure_files(figure, Path(sys.argv[1]), "figure3")
"""


@pytest.mark.parametrize(("written", "there"), [(0, set()), (1, {"figure3.png"})])
def test_a_killed_report_leaves_no_half_drawn_figure(
    written: int, there: set[str], tmp_path: Path
) -> None:
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", DRAW, tmp_path, str(written)],
        env={**os.environ, "PYTHONPATH": str(root)},
        timeout=600,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL
    assert {path.name for path in tmp_path.iterdir()} == there
    for path in tmp_path.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG")
        assert b"IEND" in path.read_bytes()[-12:]
