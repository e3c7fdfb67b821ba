"""What the pictures of trained parts show, pixel by pixel where it is a frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.learning.recordings import recording
from tests.report.trained.parts import HORIZON, artifact
from wasp_cli.report.trained.parts import Trained
from wasp_cli.report.trained.parts import evidence as pictures
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


def test_windows_are_read_as_they_were_left(layout: Layout, diagnostics: Trained) -> None:
    data = recording()
    decoded, windows = pictures.read_windows(layout, diagnostics)
    np.testing.assert_array_equal(decoded.true, data.pixels[:10])
    assert [window.title for window in windows] == ["expert, episode 0, step 1", "expert, episode 2, step 1"]
    for window, start in zip(windows, (1, 22), strict=True):
        np.testing.assert_array_equal(window.true, data.pixels[start : start + 1 + HORIZON])
        np.testing.assert_array_equal(window.model, 255 - window.true)
        np.testing.assert_array_equal(window.cost, data.cost[start : start + 1 + HORIZON])


def test_the_strip_shows_true_and_imagined_frames_in_their_rows(layout: Layout, diagnostics: Trained, tmp_path: Path) -> None:
    data, pitch = recording(), pictures.SIDE + pictures.GAP
    pictures.draw_open_loop(layout, diagnostics, tmp_path / "sheet.png")
    sheet = read(tmp_path / "sheet.png")
    top, left = pictures.TEXT + pictures.GAP, pictures.LABEL
    step = int(np.flatnonzero(data.cost[1 : 2 + HORIZON] == 0)[0])  # a red edge would cover a part of a costly one
    for row, image in enumerate((data.pixels[1 + step, :3], 255 - data.pixels[1 + step, :3], data.pixels[1 + step, 3:])):
        frame = sheet[top + row * pitch :, left + step * pitch :][: pictures.SIDE, : pictures.SIDE]
        np.testing.assert_array_equal(frame[4:-4, 4:-4], enlarged(image)[4:-4, 4:-4])


def test_decoded_frames_stand_below_the_true_ones(layout: Layout, diagnostics: Trained, tmp_path: Path) -> None:
    data, pitch = recording(), pictures.SIDE + pictures.GAP
    pictures.draw_reconstructions(layout, diagnostics, tmp_path / "sheet.png")
    sheet = read(tmp_path / "sheet.png")
    for row, image in enumerate((data.pixels[3, :3], 255 - data.pixels[3, :3], data.pixels[3, 3:], 255 - data.pixels[3, 3:])):
        frame = sheet[pictures.GAP + row * pitch :, pictures.LABEL + 3 * pitch :][: pictures.SIDE, : pictures.SIDE]
        np.testing.assert_array_equal(frame, enlarged(image))


def test_the_film_has_a_frame_for_each_step(layout: Layout, diagnostics: Trained, tmp_path: Path) -> None:
    pictures.draw_open_loop_film(layout, diagnostics, tmp_path / "film.gif")
    assert getattr(Image.open(tmp_path / "film.gif"), "n_frames", 1) == 1 + HORIZON


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

    # The first behaviour by name is the expert, with rows 0-11 and 21-35: four frames ever later in their episodes, then the costly ones
    # from both sources.
    for column, row in ((0, 1), (1, 4), (2, 30), (3, 34), (pictures.FRAMES, 4), (pictures.FRAMES + 1, 30)):
        for camera in range(2):
            np.testing.assert_array_equal(frame(column, camera), data.pixels[row, 3 * camera : 3 * camera + 3].transpose(1, 2, 0))
    top = pictures.GAP + pictures.TEXT + 1
    edges = [tuple(sheet[top, pictures.GAP + column * pitch + 1].tolist()) for column in range(pictures.FRAMES + 3)]
    assert [edge == pictures.RED for edge in edges] == [False, True, True, False, True, True, False]
