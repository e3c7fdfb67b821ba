"""The curves of a sweep: what the lines show, and that the same numbers draw the same bytes."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.report.swept import invent_sweep
from wasp_cli.report.axis_figures import MOST, positions, sweep_curves, sweep_figure, sweep_figures
from wasp_cli.report.tables.by_axis import Swept
from wasp_cli.store.tables import CellIdentity

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
