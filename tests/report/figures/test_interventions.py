"""Figure `cost_interventions`, and names beside marks."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from tests.report.made import NO_CELLS
from wasp_cli.methods.registry import METHODS
from wasp_cli.report.bootstrap import contrast_of
from wasp_cli.report.canvas import drawn
from wasp_cli.report.figures import rows_by_task
from wasp_cli.report.interventions_figure import (
    cost_interventions_figure,
    points_of,
    square_root_axis,
)
from wasp_cli.report.labels import Named, name_marks
from wasp_cli.report.stats import Frame


def test_every_assistant_and_the_operators_alone_are_named_and_no_reference_is(
    frame: Frame, tmp_path: Path
) -> None:
    _, svg = cost_interventions_figure(frame, tmp_path)
    text = svg.read_text(encoding="utf-8")
    named = {method for method in METHODS if f">{METHODS[method].title}<" in text}
    assert named == {"human", "ida", "diffusion", "saferl", "wasp"}


def test_both_numbers_have_the_hierarchical_interval_of_the_comparisons(frame: Frame) -> None:
    (rows,) = rows_by_task(frame).values()
    (group,) = (group for group in rows if group.method == "wasp")
    (point,) = (point for point in points_of(rows) if point.method == "wasp")
    for measured, key in ((point.cost, "cost"), (point.rate, "int_eff")):
        expected = contrast_of(group.cells, 0.0, key)
        assert (measured.value, measured.limits) == (expected.value, expected.bootstrap)
        low, high = measured.limits
        assert low <= measured.value <= high


def test_rows_that_do_not_say_what_an_action_changed_are_left_out(
    frame: Frame, tmp_path: Path
) -> None:
    unknown = np.full(len(frame.cells.place), np.nan)
    old = frame.cells.with_columns({"int_eff": unknown})
    assert cost_interventions_figure(Frame(old), tmp_path) == []
    assert cost_interventions_figure(Frame(NO_CELLS), tmp_path) == []


def test_an_axis_of_costs_begins_at_0_also_where_nothing_costs() -> None:
    with drawn((3.0, 3.0)) as figure:
        panel = figure.subplots()
        for most in (0.0, 30.0):
            square_root_axis(panel, most)
            low, high = panel.get_ylim()
            assert low == 0.0
            assert high > most
            assert panel.get_yticks()[0] == 0.0


def boxes_of(names: list[Named]) -> list[tuple[float, float, float, float]]:
    with drawn((4.0, 4.0)) as figure:
        panel = figure.subplots()
        panel.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
        figure.draw_without_rendering()
        name_marks(panel, names)
        extents = [text.get_window_extent() for text in panel.texts]
        room = panel.get_window_extent()
    assert all(room.x0 <= each.x0 and each.x1 <= room.x1 for each in extents)
    assert all(room.y0 <= each.y0 and each.y1 <= room.y1 for each in extents)
    return [(each.x0, each.y0, each.x1, each.y1) for each in extents]


@pytest.mark.parametrize(("place", "many"), [((0.5, 0.5), 5), ((0.99, 0.5), 5), ((0.01, 0.01), 3)])
def test_names_of_marks_in_one_place_do_not_lie_on_each_other_or_leave_the_panel(
    place, many
) -> None:
    boxes = boxes_of([Named(*place, f"an assistant {i}") for i in range(many)])
    assert len(boxes) == many
    for one, two in combinations(boxes, 2):
        apart = one[2] <= two[0] or two[2] <= one[0] or one[3] <= two[1] or two[3] <= one[1]
        assert apart, "two names overlap"
