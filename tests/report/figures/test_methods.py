"""Figures of methods, and of methods along the severities."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.axis_figures import severity_figure
from wasp_cli.report.figures import PALETTE, STYLES, cost_return_figure, profile, profile_figure
from wasp_cli.report.stats import Frame, Wanted, groups, read_frame


def test_shows_every_method_in_its_colour(frame: Frame, tmp_path: Path) -> None:
    png, svg = cost_return_figure(frame, tmp_path)
    text = svg.read_text(encoding="utf-8")
    methods = {cell.identity.method for cell in frame.cells}
    assert methods == {"human", "ida", "diffusion", "saferl", "wasp", "expert"}
    assert all(METHODS[method].title in text for method in methods)
    pixels = {tuple(pixel) for pixel in np.asarray(Image.open(png).convert("RGB")).reshape(-1, 3).tolist()}
    for method in methods:
        colour = STYLES[method][0]
        assert tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5)) in pixels


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


def test_profiles_show_every_method(frame: Frame, tmp_path: Path) -> None:
    _, svg = profile_figure(frame, tmp_path)
    assert all(METHODS[cell.identity.method].title in svg.read_text(encoding="utf-8") for cell in frame.cells)


def test_every_operator_with_its_severities_and_every_method(frame: Frame, tmp_path: Path) -> None:
    severity = severity_figure(frame, tmp_path)[1].read_text(encoding="utf-8")
    for text in ("Noisy 0.2", "Noisy 0.6", "Laggy 0.5", "Laggy 0.85", "Goal1: Return", "Goal1: Cost", "Goal1: Int.", "Human-only", "WASP"):
        assert text in severity
    assert "Expert" not in severity  # it has no severity


def test_one_condition_is_no_curve(grid: Callable[..., list[Wanted]], tmp_path: Path) -> None:
    one = [cell for cell in grid(seeds=(0,)) if cell.identity.operator == "noisy" and cell.identity.value == 0.2]
    assert severity_figure(read_frame(one), tmp_path) == []
    assert severity_figure(Frame(()), tmp_path) == cost_return_figure(Frame(()), tmp_path) == profile_figure(Frame(()), tmp_path) == []
