from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.figures.methods import cost_return_figure, profile, profile_figure
from wasp_cli.report.figures.style import LINES, PALETTE, STYLES, place_of_round
from wasp_cli.report.stats.frame import Frame, groups


def test_same_numbers_same_bytes(frame: Frame, tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    first.mkdir()
    second.mkdir()
    for one, other in zip(cost_return_figure(frame, first), cost_return_figure(frame, second), strict=True):
        assert one.read_bytes() == other.read_bytes()


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


def test_profiles_tell_methods_of_one_colour_apart(frame: Frame, tmp_path: Path) -> None:
    looks = {(STYLES[name][0], LINES[place_of_round(name)]) for name in METHODS}
    assert len(looks) == len(METHODS)
    _, svg = profile_figure(frame, tmp_path)
    assert all(METHODS[cell.identity.method].title in svg.read_text(encoding="utf-8") for cell in frame.cells)


def test_nothing_to_draw(tmp_path: Path) -> None:
    assert cost_return_figure(Frame(()), tmp_path) == profile_figure(Frame(()), tmp_path) == []
