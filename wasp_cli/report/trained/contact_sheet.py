"""A picture of a dataset for people: a few frames of every behaviour, what both cameras saw, costly ones marked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.learning.contents import COLUMNS
from wasp_cli.learning.shards import PIXELS, Recording, cost_sources, read_shards, shard_files

FRAMES = 4
"""Frames of a behaviour that are spread over all its steps, and as many costly ones."""
FRAME, GAP, EDGE, TITLE, CAPTION = 128, 8, 3, 26, 18
"""Sides and heights in px; a camera image is shown at twice its size."""
_INK, _PAPER, _COSTLY = (20, 20, 20), (255, 255, 255), (214, 39, 40)


def contact_sheet(folder: Path, path: Path) -> None:
    """Draw the dataset in `folder`: a row per behaviour, front over rear; frames whose step cost have a red edge and name the source.

    Images are read shard after shard and only the chosen ones are kept, so that memory does not grow with the dataset.
    """
    recording, sources = read_shards(folder, COLUMNS), cost_sources(folder)
    names = sorted(set(recording.behaviour.tolist()))
    chosen = {name: _chosen(recording, np.flatnonzero(recording.behaviour == name)) for name in names}
    images = _images(folder, np.unique(np.concatenate(list(chosen.values()))))
    block = TITLE + 2 * (FRAME + EDGE) + EDGE + CAPTION + GAP
    sheet = Image.new("RGB", (GAP + 2 * FRAMES * (FRAME + 2 * EDGE + GAP), GAP + len(names) * block), _PAPER)
    draw, font, small = ImageDraw.Draw(sheet), ImageFont.load_default(15), ImageFont.load_default(11)
    decision = np.arange(len(recording.first)) - np.maximum.accumulate(np.where(recording.first > 0, np.arange(len(recording.first)), 0))
    for line, name in enumerate(names):
        top = GAP + line * block
        draw.text((GAP, top + 3), f"{name}: front over rear", _INK, font)
        for column, row in enumerate(chosen[name].tolist()):
            x, y = GAP + column * (FRAME + 2 * EDGE + GAP), top + TITLE
            colour = _COSTLY if recording.cost[row] > 0 else _PAPER
            draw.rectangle((x, y, x + FRAME + 2 * EDGE - 1, y + 2 * FRAME + 3 * EDGE - 1), colour)
            for camera in range(2):
                image = Image.fromarray(np.ascontiguousarray(images[row][3 * camera : 3 * camera + 3].transpose(1, 2, 0)))
                sheet.paste(image.resize((FRAME, FRAME), Image.Resampling.NEAREST), (x + EDGE, y + EDGE + camera * (FRAME + EDGE)))
            by = " + ".join(kind for i, kind in enumerate(sources) if recording.sources[row, i] > 0)
            text = _fitting(by or f"episode {recording.episode[row]}, step {decision[row]}", small)
            draw.text((x + EDGE, y + 2 * FRAME + 3 * EDGE + 1), text, colour if by else _INK, small)
    sheet.save(path, format="PNG")


def _chosen(recording: Recording, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Frames spread over the rows of a behaviour, then costly ones, from every source in turn."""
    kinds = [rows[recording.sources[rows, i] > 0] for i in range(recording.sources.shape[1])]
    kinds = [kind for kind in kinds if len(kind)]
    costly = [_spread(kind, len(range(i, FRAMES, len(kinds)))) for i, kind in enumerate(kinds)]
    return np.concatenate([_spread_over_episodes(recording, rows), *costly])


def _spread_over_episodes(recording: Recording, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """FRAMES rows of different episodes, each later in its own: equal parts of all rows would show one moment of them again and again."""
    numbers, shares = np.unique(recording.episode[rows]), (np.arange(FRAMES) + 0.5) / FRAMES
    own = [rows[recording.episode[rows] == numbers[int(share * len(numbers))]] for share in shares]
    return np.array([part[int(share * len(part))] for part, share in zip(own, shares, strict=True)])


def _spread(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """At most `count` of the rows, from the middles of equal parts."""
    count = min(count, len(rows))
    spread: NDArray[np.int64] = rows[((np.arange(count) + 0.5) / max(1, count) * len(rows)).astype(int)]
    return spread


def _images(folder: Path, rows: NDArray[np.int64]) -> dict[int, NDArray[Any]]:
    """uint8 [6, 64, 64] of each row of the dataset."""
    images: dict[int, NDArray[Any]] = {}
    begin = 0
    for file in shard_files(folder):
        end = begin + pq.read_metadata(file).num_rows
        here = rows[(rows >= begin) & (rows < end)]
        if len(here):
            taken = pq.read_table(file, columns=["pixels"]).column("pixels").take(here - begin)
            images |= {int(row): np.frombuffer(image.as_py(), np.uint8).reshape(PIXELS) for row, image in zip(here, taken, strict=True)}
        begin = end
    return images


def _fitting(text: str, font: Any) -> str:
    """As much of a text as a frame is wide."""
    if font.getlength(text) <= FRAME:
        return text
    return next(short for end in range(len(text) - 1, -1, -1) if font.getlength(short := text[:end] + "...") <= FRAME)
