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
