"""Moments of an episode side by side, as an assistant sees them, as a PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.tasks.base import Pixels

# in px; an image is shown at four times its size
SIDE = 256
GAP = 12
CAPTION = 22
TITLE = 36
IN_A_ROW = 4
_INK = (20, 20, 20)
_COSTLY = (190, 20, 20)
_PAPER = (255, 255, 255)


class Moment(NamedTuple):
    """A moment of an episode."""

    pixels: Pixels  # [3 or 6, 64, 64]
    caption: str
    is_marked: bool  # its caption is red


def draw_strip(title: str, moments: Sequence[Moment], path: Path) -> Path:
    """Write a PNG, and return its path.

    Args:
        title: a line above all of it.
        moments: in their order, four in a row; at least one.
        path: where to.
    """
    cameras = len(moments[0].pixels) // 3
    columns = min(IN_A_ROW, len(moments))
    rows = -(-len(moments) // IN_A_ROW)
    height = cameras * SIDE + CAPTION + GAP
    sheet = Image.new("RGB", (GAP + columns * (SIDE + GAP), TITLE + rows * height), _PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((GAP, 8), title, _INK, ImageFont.load_default(16))
    small = ImageFont.load_default(13)
    for place, moment in enumerate(moments):
        x = GAP + (place % IN_A_ROW) * (SIDE + GAP)
        y = TITLE + (place // IN_A_ROW) * height
        for camera in range(cameras):
            image = np.moveaxis(moment.pixels[3 * camera : 3 * camera + 3], 0, -1)
            shown = Image.fromarray(np.ascontiguousarray(image))
            shown = shown.resize((SIDE, SIDE), Image.Resampling.NEAREST)
            sheet.paste(shown, (x, y + camera * SIDE))
        colour = _COSTLY if moment.is_marked else _INK
        draw.text((x, y + cameras * SIDE + 3), moment.caption, colour, small)
    sheet.save(path, format="PNG")
    return path
