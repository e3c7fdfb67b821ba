"""The process that draws one film for `view.films`: `python -m wasp_cli.view.draw RESULTS KEY EPISODE KIND STEP FOLDER [EVERY]`.

What may be untrusted is read and drawn here as `wasp explain` and reports do; no module is imported that a cell names.
"""

from __future__ import annotations

import math
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, features

from wasp_cli.errors import UsageError, WaspError
from wasp_cli.report.explain.stored import Episode, read_episode
from wasp_cli.store.find import FoundCell, find_cell
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.registry import TASKS
from wasp_cli.view.films import BRANCHES, REPLAY, write_state

SIZE, CAMERA, GAP = 420, 206, 8
"""In px: side of the map, of a camera image, and between them."""
QUALITY = 72
REPLAYED = 125
"""Frames at most of a film with imagined futures, which take long to draw."""


def require_drawable(stored: Episode) -> int:
    """Return the env steps of a decision.

    Raises:
        UsageError: the task is not one of ours, so that drawing it would import a module that the results name; or nothing sensible says
            how long a decision is.
    """
    task, repeat = str(stored.row["task"]), stored.constants.action_repeat
    if task not in TASKS:
        raise UsageError(f"'{task}' is no task of ours: drawing it would run a module that these results name", "wasp replay does so")
    if repeat is None or not 0 < repeat <= TASKS[task].env_steps:
        raise UsageError("its manifest does not say how long a decision is")
    return repeat


def film_frames(stored: Episode, every: int) -> Iterator[tuple[Image.Image, tuple[tuple[str, str, str], ...]]]:
    """Draw the map, and beside it what the robot's cameras see; each frame with the legend."""
    from wasp_cli.video.film import moments
    from wasp_cli.video.map import legend_of

    repeat, row = require_drawable(stored), stored.row
    found = moments(
        str(row["task"]), repeat, int(row["episode_seed"]), stored.a, stored.a_h, stored.numbers["reward"], every, SIZE, cameras=True
    )
    for moment in found:
        image = Image.new("RGB", (SIZE + GAP + CAMERA, SIZE), (255, 255, 255))
        image.paste(Image.fromarray(moment.frame), (0, 0))
        for place, seen in enumerate((moment.seen if moment.seen is not None else ())[:2]):
            side = Image.fromarray(seen).resize((CAMERA, CAMERA), Image.Resampling.NEAREST)
            image.paste(side, (SIZE + GAP, place * (CAMERA + GAP)))
        yield image, legend_of(moment.things)


def draw(layout: Layout, cell: FoundCell, episode: int, kind: str, step: int, folder: Path, every: int | None = None) -> dict[str, Any]:
    """Draw a film into a folder, frame by frame, and return what `films.Films.state` says of it then.

    Raises:
        WaspError: the episode cannot be read or played.
    """
    stored = read_episode(cell, episode)
    ending = "webp" if features.check("webp") else "png"
    if kind == BRANCHES:
        require_drawable(stored)
        from wasp_cli.video.replay_step import replay_step

        replay_step(layout, cell, episode, step, folder / f"00000.{ending}", lambda share, text: _tell(folder, share, text))
        return {"state": "done", "ready": 1, "frames": 1, "every": 1, "ending": ending, "legend": []}
    legend: tuple[tuple[str, str, str], ...] = ()
    if kind == REPLAY:
        require_drawable(stored)
        from wasp_cli.video.replay import replay_frames

        every = every or math.ceil(stored.decisions / REPLAYED)
        count = math.ceil(stored.decisions / every)
        images: Iterator[tuple[Image.Image, tuple[tuple[str, str, str], ...]]] = (
            (Image.fromarray(np.asarray(frame)), ()) for frame in replay_frames(layout, cell, episode, every)
        )
    else:
        every = every or 1
        count = math.ceil(stored.decisions / every) + 1
        images = film_frames(stored, every)
    number = 0
    for number, (image, legend) in enumerate(images, 1):
        part = folder / "frame.part"
        image.save(part, format=ending.upper(), **({"quality": QUALITY, "method": 2} if ending == "webp" else {}))
        part.replace(folder / f"{number - 1:05d}.{ending}")
        write_state(folder, _state("drawing", number, max(count, number), every, ending, legend))
    return _state("done", number, number, every, ending, legend)


def _state(state: str, ready: int, frames: int, every: int, ending: str, legend: tuple[tuple[str, str, str], ...]) -> dict[str, Any]:
    return {"state": state, "ready": ready, "frames": frames, "every": every, "ending": ending, "legend": [list(each) for each in legend]}


def _tell(folder: Path, share: float, text: str) -> None:
    write_state(folder, {"state": "drawing", "ready": 0, "frames": 0, "share": round(share, 3), "text": text})


def main(arguments: list[str], say: Callable[[str], Any] = print) -> int:
    """Draw what the arguments say; the exit code is 0 also where the film could not be drawn, and its state says why."""
    results, key, episode, kind, step, target, *rest = arguments
    folder = Path(target)
    os.nice(5)  # pages go first
    layout = Layout(Path(results))
    try:
        write_state(folder, draw(layout, find_cell(layout, key), int(episode), kind, int(step), folder, int(rest[0]) if rest else None))
    except WaspError as error:
        problem = error.message + (f" ({error.hint})" if error.hint else "")
        write_state(folder, {"state": "failed", "ready": 0, "frames": 0, "problem": problem})
    except Exception as error:
        say(traceback.format_exc())
        problem = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        write_state(folder, {"state": "failed", "ready": 0, "frames": 0, "problem": problem})
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
