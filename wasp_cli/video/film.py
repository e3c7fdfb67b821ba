"""From a stored cell to the video of one of its episodes. T = decisions of the episode, A = action size, L = residual steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from PIL import Image

from wasp_cli.video.encode import checked, write
from wasp_cli.video.frame import Painter
from wasp_cli.video.timeline import Told
from wasp_cli.video.trace import Retraced, Source, retrace

Progress = Callable[[float, str], None]

SLOWER = 2.0
"""How much slower than real time a video is: there is much to see in a decision."""
LAST_MS = 2000
"""How long the last frame stays."""
_PLAYED = 0.3
"""Share of the time that playing the cell takes."""


class Correction(NamedTuple):
    """What is imagined beside the commands alone."""

    residuals: Sequence[NDArray[Any] | None]
    """T times [L, A], or None where the command stood"""
    name: str
    """what it is, for people"""
    hold: bool
    """residuals are added to the present command, not to the imagined ones"""


class Made(NamedTuple):
    """A written video."""

    frames: int
    r2: dict[str, float] | None
    """of the readout that draws imagined ways (forward, left, turn); None where there is none"""


def film_episode(
    source: Source, told: Told, episode: int, correction: Correction, horizon: int, every: int, out: Path, progress: Progress
) -> Made:
    """Play a cell again and write the video of an episode.

    Args:
        source: the cell.
        told: what its rows say of the episode.
        episode: which one.
        correction: what is imagined beside the commands alone.
        horizon: imagined steps.
        every: decisions between two frames; the last one has a frame too.
        out: the file; see `video_file.checked`.
        progress: told the share that is done.

    Raises:
        UsageError: the file cannot be one.
        ArtifactError: a model is damaged, or what is played is not what was recorded.
        TaskError: the task cannot be imported.
    """
    checked(out)
    shown = sorted({*range(0, told.length, every), told.length - 1})
    found = retrace(source, episode, correction.residuals, shown, horizon, lambda share, text: progress(_PLAYED * share, text))
    frames = _Frames(found, told, horizon, correction)

    def painted(index: int) -> None:
        progress(_PLAYED + (1 - _PLAYED) * index / len(shown), f"frame {index + 1} of {len(shown)}")

    times = [round(1000 * SLOWER * told.decision_seconds * (after - t)) for t, after in pairwise(shown)]
    before = torch.get_num_threads()
    torch.set_num_threads(source.threads)
    try:
        write(out, len(shown), frames.paint, [*times, LAST_MS], painted)
    finally:
        torch.set_num_threads(before)
    names = ("forward", "left", "turn")
    r2 = None if found.readout is None else dict(zip(names, found.explained.tolist(), strict=True))
    return Made(len(shown), r2)


class _Frames:
    """Paints the frames in any order, though a map that follows its robot is to be painted from the first one on."""

    def __init__(self, found: Retraced, told: Told, horizon: int, correction: Correction) -> None:
        self._found, self._told, self._horizon, self._correction = found, told, horizon, correction
        self._painter, self._next = self._fresh(), 0

    def _fresh(self) -> Painter:
        return Painter(self._found, self._told, self._horizon, hold=self._correction.hold, corrected=self._correction.name)

    def paint(self, index: int) -> Image.Image:
        if index < self._next:
            self._painter = self._fresh()
        self._next = index + 1
        return self._painter.frame(self._found.instants[index])
