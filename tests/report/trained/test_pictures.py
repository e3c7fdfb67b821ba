"""What the pictures of trained parts show, pixel by pixel where it is a frame."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.learning.recordings import recording
from tests.report.trained.parts import HORIZON, artifact
from wasp_cli.report.trained import Trained
from wasp_cli.report.trained import evidence as pictures
from wasp_cli.store.layout import Layout

Array = np.ndarray[Any, Any]


@pytest.fixture(scope="module")
def layout(tmp_path_factory: pytest.TempPathFactory) -> Layout:
    return Layout(tmp_path_factory.mktemp("store"))


@pytest.fixture(scope="module")
def diagnostics(layout: Layout) -> Trained:
    return artifact(layout, "diagnostics")


def read(path: Path) -> Array:
    return np.asarray(Image.open(path).convert("RGB"))


def enlarged(image: Array) -> Array:
    """[3, 64, 64] at the size of a frame."""
    shown = Image.fromarray(np.ascontiguousarray(image.transpose(1, 2, 0)))
    return np.asarray(shown.resize((pictures.SIDE,) * 2, Image.Resampling.NEAREST))


def test_the_strip_shows_true_and_imagined_frames_in_their_rows(layout: Layout, diagnostics: Trained, tmp_path: Path) -> None:
    data, pitch = recording(), pictures.SIDE + pictures.GAP
    pictures.draw_open_loop(layout, diagnostics, tmp_path / "sheet.png")
    sheet = read(tmp_path / "sheet.png")
    top, left = pictures.TEXT + pictures.GAP, pictures.LABEL
    step = int(np.flatnonzero(data.cost[1 : 2 + HORIZON] == 0)[0])  # a red edge would cover a part of a costly one
    for row, image in enumerate((data.pixels[1 + step, :3], 255 - data.pixels[1 + step, :3], data.pixels[1 + step, 3:])):
        frame = sheet[top + row * pitch :, left + step * pitch :][: pictures.SIDE, : pictures.SIDE]
        np.testing.assert_array_equal(frame[4:-4, 4:-4], enlarged(image)[4:-4, 4:-4])


def test_the_sheet_shows_the_frames_and_marks_the_costly_ones(layout: Layout, tmp_path: Path) -> None:
    data = recording()
    pictures.draw_contact_sheet(layout, artifact(layout, "dataset"), tmp_path / "sheet.png")
    sheet, size = read(tmp_path / "sheet.png"), pictures.FRAME
    pitch = size + 2 * pictures.EDGE + pictures.GAP
    assert sheet.shape[1] == pictures.GAP + 2 * pictures.FRAMES * pitch

    def frame(column: int, camera: int) -> Array:
        top = pictures.GAP + pictures.TEXT + pictures.EDGE + camera * (size + pictures.EDGE)
        left = pictures.GAP + column * pitch + pictures.EDGE
        return sheet[top : top + size : 2, left : left + size : 2]

    # The first behaviour by name is the expert: four of its frames, then the costly ones from both sources.
    shown = [
        next(row for row in range(36) if np.array_equal(frame(column, 0), data.pixels[row, :3].transpose(1, 2, 0))) for column in range(6)
    ]
    assert sorted(shown[:4]) == shown[:4]
    assert shown[4:] == [4, 30]
    for column, row in enumerate(shown):
        np.testing.assert_array_equal(frame(column, 1), data.pixels[row, 3:].transpose(1, 2, 0))
    top = pictures.GAP + pictures.TEXT + 1
    edges = [tuple(sheet[top, pictures.GAP + column * pitch + 1].tolist()) == pictures.RED for column in range(6)]
    assert edges == [row in (4, 30) for row in shown]
