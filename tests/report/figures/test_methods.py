from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.figures.methods import cost_return_figure
from wasp_cli.report.figures.style import PALETTE, STYLES
from wasp_cli.report.stats.frame import Frame


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


def test_nothing_to_draw(tmp_path: Path) -> None:
    assert cost_return_figure(Frame(()), tmp_path) == []
