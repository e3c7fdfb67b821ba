"""Moments of an episode side by side, as an assistant sees them, as a PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.tasks.base import Pixels

SIDE, GAP, CAPTION, TITLE = 256, 12, 22, 36  # px; an image is shown at four times its size
IN_A_ROW = 4
_INK = (20, 20, 20)
_COSTLY = (190, 20, 20)
_PAPER = (255, 255, 255)


def draw_strip(title: str, moments: Sequence[tuple[Pixels, str, bool]], path: Path) -> Path:
    """Write a PNG, and return its path.

    Args:
        title: a line above all of it.
        moments: the images [3 or 6, 64, 64] of each moment, the text below it, and whether that
            is to be marked.
        path: where to.
    """
    cameras = len(moments[0][0]) // 3
    columns = min(IN_A_ROW, len(moments))
    rows = -(-len(moments) // IN_A_ROW)
    height = cameras * SIDE + CAPTION + GAP
    sheet = Image.new("RGB", (GAP + columns * (SIDE + GAP), TITLE + rows * height), _PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((GAP, 8), title, _INK, ImageFont.load_default(16))
    small = ImageFont.load_default(13)
    for place, (pixels, text, is_marked) in enumerate(moments):
        x = GAP + (place % IN_A_ROW) * (SIDE + GAP)
        y = TITLE + (place // IN_A_ROW) * height
        for camera in range(cameras):
            image = np.moveaxis(pixels[3 * camera : 3 * camera + 3], 0, -1)
            shown = Image.fromarray(np.ascontiguousarray(image))
            sheet.paste(
                shown.resize((SIDE, SIDE), Image.Resampling.NEAREST), (x, y + camera * SIDE)
            )
        draw.text((x, y + cameras * SIDE + 3), text, _COSTLY if is_marked else _INK, small)
    sheet.save(path, format="PNG")
    return path
