"""Figures of methods, and of methods along the severities."""

import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from tests.report.swept import NUMBERS, invent_sweep
from wasp_cli.methods.registry import METHODS
from wasp_cli.report import axis_figures as by_axis
from wasp_cli.report import figures as methods
from wasp_cli.report.axis_figures import MOST, positions, severity_figure, sweep_curves, sweep_figure, sweep_figures
from wasp_cli.report.figures import PALETTE, STYLES, cost_return_figure, profile, profile_figure
from wasp_cli.report.stats import Frame, Wanted, groups, read_frame
from wasp_cli.report.tables.by_axis import Swept
from wasp_cli.store.tables import CellIdentity


def test_shows_every_method_in_its_colour(frame: Frame, tmp_path: Path) -> None:
    png, svg = cost_return_figure(frame, tmp_path)
    texts = [path.read_text(encoding="utf-8") for path in (svg, profile_figure(frame, tmp_path)[1])]
    methods = {cell.identity.method for cell in frame.cells}
    assert methods == {"human", "ida", "diffusion", "saferl", "wasp", "expert"}
    assert all(METHODS[method].title in text for method in methods for text in texts)
    pixels = {tuple(pixel) for pixel in np.asarray(Image.open(png).convert("RGB")).reshape(-1, 3).tolist()}
    for method in methods:
        colour = STYLES[method][0]
        assert tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5)) in pixels


def test_an_assistant_from_a_file_of_ones_own_is_drawn_too(frame: Frame, tmp_path: Path) -> None:
    cells = [cell for cell in frame.cells if cell.identity.method == "ida"]
    own = [replace(cell, identity=replace(cell.identity, method="halfway:Halfway")) for cell in cells]
    for draw in (cost_return_figure, profile_figure):
        _, svg = draw(Frame((*frame.cells, *own)), tmp_path)
        assert "Halfway" in svg.read_text(encoding="utf-8")


def test_methods_differ_in_colour_and_marker() -> None:
    assert len(set(STYLES.values())) == len(STYLES)
    first = list(STYLES.values())[: len(PALETTE)]
    assert len({colour for colour, _ in first}) == len({marker for _, marker in first}) == len(first)


def test_a_profile_is_the_share_of_episodes_on_the_better_side(frame: Frame) -> None:
    for group in groups(frame):
        for key, at_least in (("return", True), ("cost", False)):
            x, share = profile(group, key, at_least=at_least)
            for value in x:
                met = [np.mean(cell.episodes[key] >= value if at_least else cell.episodes[key] <= value) for cell in group.cells]
                # Equal values make a step: the curve meets the share at one end of it.
                ends = share[x == value]
                assert np.isclose(ends.max(), np.mean(met))


def test_one_condition_is_no_curve(grid: Callable[..., list[Wanted]], tmp_path: Path) -> None:
    one = [cell for cell in grid(seeds=(0,)) if cell.identity.operator == "noisy" and cell.identity.value == 0.2]
    assert severity_figure(read_frame(one), tmp_path) == []
    assert severity_figure(Frame(()), tmp_path) == cost_return_figure(Frame(()), tmp_path) == profile_figure(Frame(()), tmp_path) == []


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


# The curves of a sweep: what the lines show, and that the same numbers draw the same bytes.


KEY = "diffusion.ratio"


def panels_of(swept: list[Swept], key: str = KEY) -> list[Any]:
    figure = sweep_figure(key, swept, "goal1")
    return list(figure.axes)


def drawn(panel: Any) -> dict[str, tuple[list[float], list[float]]]:
    """By label the x and y of every curve; Human-only begins with an underscore."""
    found = {bar.get_label(): bar[0].get_data() for bar in panel.containers}
    found |= {line.get_label(): line.get_data() for line in panel.lines if line.get_label().startswith("_Noisy")}
    return {label: (list(x), list(y)) for label, (x, y) in found.items()}


def test_the_lines_carry_the_numbers_of_the_table(tmp_path: Path) -> None:
    returns, success, cost, mag = map(drawn, panels_of(invent_sweep(tmp_path)))
    assert returns == {
        "Noisy 0.2": ([0, 0.2, 0.6], [7, 8, 9]),
        "Noisy 0.6": ([0, 0.2, 0.6], [6, 7, 8]),
        "_Noisy 0.2": ([0, 0.2, 0.6], [7, 7, 7]),
        "_Noisy 0.6": ([0, 0.2, 0.6], [6, 6, 6]),
    }
    assert success["Noisy 0.2"][1] == [100, 100, 100]  # percent
    assert (cost["Noisy 0.2"][1][0], cost["Noisy 0.2"][1][2], cost["_Noisy 0.2"][1]) == (50, 0, [50, 50, 50])
    assert mag["Noisy 0.6"][1] == pytest.approx([0.0625, 0.125, 0.1875])
    assert mag["_Noisy 0.6"][1] == [0, 0, 0]


def test_the_bars_are_the_spread_over_seeds(tmp_path: Path) -> None:
    swept = invent_sweep(tmp_path)
    _, _, cost, _ = panels_of(swept)
    ends = next(bar for bar in cost.containers if bar.get_label() == "Noisy 0.2")[1]
    half = (ends[1].get_ydata() - ends[0].get_ydata()) / 2
    costs = [
        [cell.pooled["cost"] for cell in each.frame.cells if cell.identity.method == "diffusion" and cell.identity.value == 0.2]
        for each in swept
    ]
    assert list(half) == pytest.approx([np.std(pair, ddof=1) for pair in costs])
    assert half[1] > 0


def test_numbers_are_to_scale_in_their_order_and_words_are_categories(tmp_path: Path) -> None:
    mixed = panels_of(invent_sweep(tmp_path / "a", (("0.6", 0.6), ("0", 0), ("0.2", 0.2))))[0]
    assert drawn(mixed)["Noisy 0.2"] == ([0, 0.2, 0.6], [8, 9, 7])
    words = panels_of(invent_sweep(tmp_path / "b", (("hold", "hold"), ("per_step", "per_step"))), "wasp.composition")[0]
    assert drawn(words)["Noisy 0.2"] == ([0, 1], [7, 8])
    assert [label.get_text() for label in words.get_xticklabels()] == ["hold", "per_step"]
    assert words.get_xlabel() == "wasp.composition"
    assert positions([True, False]) == ([0, 1], False)
    assert positions([None, 2]) == ([0, 1], False)


def test_many_operators_become_their_mean(tmp_path: Path) -> None:
    conditions = [("noisy", number / 10) for number in range(1, MOST + 2)]
    swept = invent_sweep(tmp_path, conditions=conditions, seeds=(0,))
    (found,) = sweep_curves(swept, "goal1").values()
    assert [curve.label for curve in found] == ["mean of 7 operators"]
    y = panels_of(swept)[0].containers[0][0].get_ydata()
    expected = [np.mean([cell.pooled["return"] for cell in each.frame.cells if cell.identity.method == "diffusion"]) for each in swept]
    assert list(y) == pytest.approx(expected)
    assert expected[1] > expected[0]


def test_a_point_with_missing_cells_is_left_out_and_told(tmp_path: Path) -> None:
    swept = invent_sweep(tmp_path, missing=[CellIdentity("goal1", "diffusion", "full", "noisy", 0.6, 1)])
    figure = sweep_figure(KEY, swept, "goal1")
    found = drawn(figure.axes[0])
    assert math.isnan(found["Noisy 0.6"][1][0])
    assert found["Noisy 0.6"][1][1:] == [7, 8]
    assert found["Noisy 0.2"][1] == [7, 8, 9]
    assert figure.get_suptitle() == "Goal1, Diffusion (cells are missing: 1 point left out)"


def test_nothing_to_draw(tmp_path: Path) -> None:
    conditions = [("noisy", 0.2)]
    lost = [CellIdentity("goal1", "diffusion", "full", "noisy", 0.2, 0)]
    (first, _) = invent_sweep(tmp_path, (("1", 1), ("2", 2)), conditions, seeds=(0,), missing=lost)
    again = Swept("2", 2, first.frame, {identity: f"again{key}" for identity, key in first.keys.items()})
    assert sweep_figure(KEY, [first, again], "goal1") is None  # Human-only alone is no curve of the setting
    assert sweep_figures(KEY, [first, again], tmp_path) == []


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
def test_a_killed_report_leaves_no_half_drawn_figure(written: int, there: set[str], tmp_path: Path) -> None:
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", DRAW, tmp_path, str(written)], env={**os.environ, "PYTHONPATH": str(root)}, timeout=600, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert {path.name for path in tmp_path.iterdir()} == there
    for path in tmp_path.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG")
        assert b"IEND" in path.read_bytes()[-12:]
