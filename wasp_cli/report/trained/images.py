"""Pictures of what a world model sees and imagines, from the frames that its diagnostics leave."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.report.trained.artifacts import PIXELS, Floats, Trained, read_table
from wasp_cli.store.layout import Layout

COLUMNS = ("window", "step", "behaviour", "episode", "decision", "cost", "predicted", "true", "model")
FRAMES, WINDOWS = 1000, 16
"""Frames that a file may have, and imagined windows that are drawn at most."""
SIDE, GAP, LABEL, BAR, TEXT = 96, 4, 92, 26, 15
"""Sizes in px: a frame, between frames, the names of the rows, the bars of costs, a line of text."""
_INK, _PAPER, _TRUE, _IMAGINED = (20, 20, 20), (255, 255, 255), (214, 39, 40), (31, 119, 180)

Images = NDArray[np.uint8]


class Window(NamedTuple):
    """K frames beside each other. Of an imagined window the first one is the start, seen and not imagined."""

    title: str
    true: Images
    """[K, 6, 64, 64]"""
    model: Images
    """[K, 6, 64, 64] decoded or imagined"""
    cost: Floats
    """[K] real cost"""
    predicted: Floats
    """[K] probability of a cost"""


def read_windows(layout: Layout, artifact: Trained) -> tuple[Window | None, list[Window]]:
    """Read the decoded frames and the imagined windows of a `diagnostics` artifact.

    Raises:
        ValueError, KeyError, OSError, StoreError, pyarrow.ArrowException: there are none, or they do not read.
    """
    table = read_table(layout, artifact, "images.parquet", COLUMNS, FRAMES)
    of = np.asarray(table["window"], np.int64)
    rows: dict[str, list[Any]] = {name: table[name].to_pylist() for name in ("behaviour", "episode", "decision", "true", "model")}
    cost, predicted = (np.nan_to_num(np.asarray(table[name], np.float64)) for name in ("cost", "predicted"))

    def window(number: int) -> Window:
        places = np.flatnonzero(of == number).tolist()
        first = places[0]
        title = f"{rows['behaviour'][first]}, episode {rows['episode'][first]}, step {rows['decision'][first]}"
        true, model = (np.stack([_image(rows[name][i]) for i in places]) for name in ("true", "model"))
        return Window(title[:200], true, model, cost[places], np.clip(predicted[places], 0.0, 1.0))

    numbers = sorted(set(of[of >= 0].tolist()))[:WINDOWS]
    return window(-1) if (of == -1).any() else None, [window(number) for number in numbers]


def draw_reconstructions(layout: Layout, artifact: Trained, path: Path) -> None:
    """Draw true front, decoded front, true rear, decoded rear of filtered states, one below the other; costly ones are named."""
    decoded, _ = read_windows(layout, artifact)
    if decoded is None:
        return
    columns = len(decoded.cost)
    sheet = Image.new("RGB", (LABEL + columns * (SIDE + GAP) + GAP, 4 * (SIDE + GAP) + GAP + TEXT), _PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(11)
    for row, (name, images, camera) in enumerate(_rows(decoded, "decoded")):
        y = GAP + row * (SIDE + GAP)
        draw.text((GAP, y + SIDE // 2 - 6), name, _INK, font)
        for column in range(columns):
            sheet.paste(_frame(images[column], camera), (LABEL + column * (SIDE + GAP), y))
    for column in np.flatnonzero(decoded.cost > 0).tolist():
        draw.text((LABEL + column * (SIDE + GAP), 4 * (SIDE + GAP) + 1), "costs", _TRUE, font)
    sheet.save(path, format="PNG")


def draw_open_loop(layout: Layout, artifact: Trained, path: Path) -> None:
    """Draw a block per imagined window: true front, imagined front, true rear, imagined rear, and predicted and real cost of each step."""
    _, windows = read_windows(layout, artifact)
    if not windows:
        return
    columns = max(len(window.cost) for window in windows)
    block = TEXT + 4 * (SIDE + GAP) + BAR + TEXT + 3 * GAP
    sheet = Image.new("RGB", (LABEL + columns * (SIDE + GAP) + GAP, len(windows) * block), _PAPER)
    draw = ImageDraw.Draw(sheet)
    for number, window in enumerate(windows):
        _block(sheet, draw, window, number * block)
    sheet.save(path, format="PNG")


def _block(sheet: Image.Image, draw: ImageDraw.ImageDraw, window: Window, top: int) -> None:
    font, bold, columns = ImageFont.load_default(11), ImageFont.load_default(13), len(window.cost)
    draw.text((GAP, top), f"{window.title}: seen at 0, then {columns - 1} steps imagined under the true actions", _INK, bold)
    for row, (name, images, camera) in enumerate(_rows(window, "imagined")):
        y = top + TEXT + GAP + row * (SIDE + GAP)
        draw.text((GAP, y + SIDE // 2 - 6), name, _INK, font)
        for column in range(columns):
            x = LABEL + column * (SIDE + GAP)
            sheet.paste(_frame(images[column], camera), (x, y))
            if window.cost[column] > 0:
                draw.rectangle((x - 2, y - 2, x + SIDE + 1, y + SIDE + 1), outline=_TRUE, width=2)
    base = top + TEXT + GAP + 4 * (SIDE + GAP) + BAR
    draw.text((GAP, base - BAR), "predicted cost", _IMAGINED, font)
    draw.text((GAP, base - BAR // 2), "real cost", _TRUE, font)
    for column in range(columns):
        x, high = LABEL + column * (SIDE + GAP), round((BAR - 2) * float(window.predicted[column]))
        draw.line((x, base, x + SIDE, base), _INK)
        draw.rectangle((x + 4, base - high, x + SIDE // 2 - 4, base), _IMAGINED)
        if window.cost[column] > 0:
            draw.rectangle((x + SIDE // 2 + 4, base - BAR + 2, x + SIDE - 4, base), _TRUE)
        draw.text((x + 4, base + 1), f"{column}:  {window.predicted[column]:.2f}", _IMAGINED, font)


def draw_open_loop_film(layout: Layout, artifact: Trained, path: Path) -> None:
    """Draw the imagined windows side by side as an animated GIF: true over imagined, front then rear; a red edge marks a real cost."""
    _, windows = read_windows(layout, artifact)
    if not windows:
        return
    frames = [_moment(windows, step) for step in range(min(len(window.cost) for window in windows))]
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=[1000, *[250] * (len(frames) - 1)], loop=0)


def _moment(windows: Sequence[Window], step: int) -> Image.Image:
    """One step of all windows."""
    frame = Image.new("RGB", (LABEL + len(windows) * (SIDE + GAP), TEXT + 4 * (SIDE + GAP) + TEXT), _PAPER)
    draw, font = ImageDraw.Draw(frame), ImageFont.load_default(11)
    draw.text((GAP, 1), f"step {step}" if step else "seen (step 0)", _INK, font)
    for column, window in enumerate(windows):
        x = LABEL + column * (SIDE + GAP)
        for row, (name, images, camera) in enumerate(_rows(window, "imagined")):
            y = TEXT + row * (SIDE + GAP)
            if column == 0:
                draw.text((GAP, y + SIDE // 2 - 6), name, _INK, font)
            frame.paste(_frame(images[step], camera), (x, y))
            if window.cost[step] > 0:
                draw.rectangle((x, y, x + SIDE - 1, y + SIDE - 1), outline=_TRUE, width=3)
        draw.text((x, TEXT + 4 * (SIDE + GAP)), f"cost: {window.predicted[step]:.2f}", _IMAGINED, font)
    return frame.convert("P", palette=Image.Palette.ADAPTIVE)


def _rows(window: Window, word: str) -> tuple[tuple[str, Images, int], ...]:
    """Name, images and first channel of the four rows of a picture."""
    true, model = window.true, window.model
    return ("true front", true, 0), (f"{word} front", model, 0), ("true rear", true, 3), (f"{word} rear", model, 3)


def _image(data: bytes) -> Images:
    return np.frombuffer(data, np.uint8).reshape(PIXELS)


def _frame(image: Images, camera: int) -> Image.Image:
    """One camera of [6, 64, 64] at the size of a frame."""
    shown = Image.fromarray(np.ascontiguousarray(image[camera : camera + 3].transpose(1, 2, 0)))
    return shown.resize((SIDE, SIDE), Image.Resampling.NEAREST)
