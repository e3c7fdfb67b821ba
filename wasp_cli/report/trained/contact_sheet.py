"""Picture of a dataset: a few frames of every behaviour, what both cameras saw, costly ones marked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.report.trained.artifacts import PIXELS, Trained, open_parquet
from wasp_cli.store.layout import Layout

FRAMES = 4
"""Frames of a behaviour that are spread over all its steps, and as many costly ones."""
BEHAVIOURS = 40
"""Behaviours that are drawn at most."""
FRAME, GAP, EDGE, TITLE, CAPTION = 128, 8, 3, 26, 18
"""Sides and heights in px; a camera image is shown at twice its size."""
NAME = 200
"""Characters of a name that are drawn at most."""
COSTLY = (214, 39, 40)
_INK, _PAPER = (20, 20, 20), (255, 255, 255)
_BATCH = 256
"""Rows whose images are in memory together."""
_SOURCES = b"wasp.cost_sources"
"""Key of a shard's schema metadata: the names of the columns of `sources`, as JSON."""

Ints = NDArray[np.int64]


class Steps(NamedTuple):
    """The rows of a dataset without their images, N in all; see `learning.shards`."""

    first: NDArray[np.bool_]
    """[N] begins an episode"""
    cost: NDArray[np.bool_]
    """[N]"""
    sources: NDArray[np.bool_]
    """[N, S] which cost source cost"""
    episode: Ints
    """[N]"""
    behaviour: NDArray[Any]
    """[N] str"""
    names: tuple[str, ...]
    """of the S cost sources"""


def draw_contact_sheet(layout: Layout, artifact: Trained, path: Path) -> None:
    """Draw a row per behaviour of a dataset, front over rear; frames whose step cost have a red edge and name the source.

    Images are read batch after batch and only the chosen ones are kept, so that memory does not grow with the dataset.

    Raises:
        ValueError, KeyError, OSError, StoreError, pyarrow.ArrowException: a shard does not read.
    """
    shards = sorted(layout.artifact(artifact.kind, artifact.key).glob("shard-*.parquet"))
    if not shards:
        return
    steps = _steps(layout, shards)
    names = sorted(set(steps.behaviour.tolist()))[:BEHAVIOURS]
    chosen = {name: _chosen(steps, np.flatnonzero(steps.behaviour == name)) for name in names}
    images = _images(layout, shards, np.unique(np.concatenate(list(chosen.values()))))
    block = TITLE + 2 * (FRAME + EDGE) + EDGE + CAPTION + GAP
    sheet = Image.new("RGB", (GAP + 2 * FRAMES * (FRAME + 2 * EDGE + GAP), GAP + len(names) * block), _PAPER)
    draw, font, small = ImageDraw.Draw(sheet), ImageFont.load_default(15), ImageFont.load_default(11)
    decision = np.arange(len(steps.first)) - np.maximum.accumulate(np.where(steps.first, np.arange(len(steps.first)), 0))
    for line, name in enumerate(names):
        top = GAP + line * block
        draw.text((GAP, top + 3), f"{name[:NAME]}: front over rear", _INK, font)
        for column, row in enumerate(chosen[name].tolist()):
            x, y = GAP + column * (FRAME + 2 * EDGE + GAP), top + TITLE
            colour = COSTLY if steps.cost[row] else _PAPER
            draw.rectangle((x, y, x + FRAME + 2 * EDGE - 1, y + 2 * FRAME + 3 * EDGE - 1), colour)
            for camera in range(2):
                image = Image.fromarray(np.ascontiguousarray(images[row][3 * camera : 3 * camera + 3].transpose(1, 2, 0)))
                sheet.paste(image.resize((FRAME, FRAME), Image.Resampling.NEAREST), (x + EDGE, y + EDGE + camera * (FRAME + EDGE)))
            by = " + ".join(kind for kind, costs in zip(steps.names, steps.sources[row], strict=True) if costs)
            text = _fitting(by[:NAME] or f"episode {steps.episode[row]}, step {decision[row]}", small)
            draw.text((x + EDGE, y + 2 * FRAME + 3 * EDGE + 1), text, colour if by else _INK, small)
    sheet.save(path, format="PNG")


def _steps(layout: Layout, shards: list[Path]) -> Steps:
    """Everything but the images, shard after shard."""
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in Steps._fields[:-1]}
    sources: tuple[str, ...] = ()
    for shard in shards:
        with open_parquet(layout, shard) as file:
            sources = tuple(map(str, json.loads((file.schema_arrow.metadata or {})[_SOURCES])))
            table = file.read(columns=list(parts), use_threads=False)
        for name in ("first", "cost"):
            parts[name].append(np.asarray(table[name], np.float64) > 0)
        parts["sources"].append(np.asarray(table["sources"].combine_chunks().flatten(), np.int64).reshape(len(table), len(sources)) > 0)
        parts["episode"].append(np.asarray(table["episode"], np.int64))
        parts["behaviour"].append(np.asarray(table["behaviour"].to_pylist(), str))
    whole = {name: np.concatenate(arrays) for name, arrays in parts.items()}
    return Steps(**whole, names=sources)


def _chosen(steps: Steps, rows: Ints) -> Ints:
    """Frames spread over the rows of a behaviour, then costly ones, from every source in turn."""
    kinds = [rows[steps.sources[rows, i]] for i in range(steps.sources.shape[1])]
    kinds = [kind for kind in kinds if len(kind)]
    costly = [_spread(kind, len(range(i, FRAMES, len(kinds)))) for i, kind in enumerate(kinds)]
    return np.concatenate([_spread_over_episodes(steps, rows), *costly])


def _spread_over_episodes(steps: Steps, rows: Ints) -> Ints:
    """FRAMES rows of different episodes, each later in its own: equal parts of all rows would show one moment of them again and again."""
    numbers, shares = np.unique(steps.episode[rows]), (np.arange(FRAMES) + 0.5) / FRAMES
    own = [rows[steps.episode[rows] == numbers[int(share * len(numbers))]] for share in shares]
    return np.array([part[int(share * len(part))] for part, share in zip(own, shares, strict=True)])


def _spread(rows: Ints, count: int) -> Ints:
    """At most `count` of the rows, from the middles of equal parts."""
    count = min(count, len(rows))
    spread: Ints = rows[((np.arange(count) + 0.5) / max(1, count) * len(rows)).astype(int)]
    return spread


def _images(layout: Layout, shards: list[Path], rows: Ints) -> dict[int, NDArray[np.uint8]]:
    """uint8 [6, 64, 64] of each row of the dataset."""
    images: dict[int, NDArray[np.uint8]] = {}
    begin = 0
    for shard in shards:
        with open_parquet(layout, shard) as file:
            for batch in file.iter_batches(_BATCH, columns=["pixels"], use_threads=False):
                for row in rows[(rows >= begin) & (rows < begin + len(batch))].tolist():
                    images[row] = np.frombuffer(batch.column(0)[row - begin].as_py(), np.uint8).reshape(PIXELS)
                begin += len(batch)
    return images


def _fitting(text: str, font: Any) -> str:
    """As much of a text as a frame is wide."""
    if font.getlength(text) <= FRAME:
        return text
    return next(short for end in range(len(text) - 1, -1, -1) if font.getlength(short := text[:end] + "...") <= FRAME)
