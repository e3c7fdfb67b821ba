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

from PIL import Image, features

from wasp_cli.errors import UsageError, WaspError
from wasp_cli.report.explain.stored import Episode, read_episode
from wasp_cli.store.find import FoundCell, find_cell
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.registry import TASKS
from wasp_cli.view.films import BRANCHES, REPLAY, problem_of, write_state

SIZE, CAMERA, GAP = 420, 206, 8  # in px: side of the map, of a camera image, and between them
QUALITY = 72
REPLAYED = 125  # frames at most of a film with imagined futures, which take long to draw
Legend = tuple[tuple[str, str, str], ...]  # what a map shows: name, colour and meaning of each


def require_drawable(stored: Episode) -> int:
    """Return the env steps of a decision; a UsageError where drawing would import a module that the results name, or last for hours."""
    task, repeat = str(stored.row["task"]), stored.constants.action_repeat
    if task not in TASKS:
        raise UsageError(f"'{task}' is no task of ours: drawing it would run a module that these results name", "wasp replay does so")
    if repeat is None or not 0 < repeat <= TASKS[task].env_steps:
        raise UsageError("its manifest does not say how long a decision is")
    return repeat


def film_frames(stored: Episode, every: int) -> Iterator[tuple[Image.Image, Legend]]:
    """Draw the map, and beside it what the robot's cameras see; each frame with the legend."""
    from wasp_cli.video.film import film
    from wasp_cli.video.map import legend_of

    repeat, row = require_drawable(stored), stored.row
    seed, rewards = int(row["episode_seed"]), stored.numbers["reward"]
    for moment in film(str(row["task"]), repeat, seed, stored.a, stored.a_h, rewards, every, SIZE, cameras=True):
        image = Image.new("RGB", (SIZE + GAP + CAMERA, SIZE), (255, 255, 255))
        image.paste(Image.fromarray(moment.frame), (0, 0))
        for place, seen in enumerate((moment.seen if moment.seen is not None else ())[:2]):
            side = Image.fromarray(seen).resize((CAMERA, CAMERA), Image.Resampling.NEAREST)
            image.paste(side, (SIZE + GAP, place * (CAMERA + GAP)))
        yield image, legend_of(moment.things)


def draw(layout: Layout, cell: FoundCell, episode: int, kind: str, step: int, folder: Path, every: int | None = None) -> dict[str, Any]:
    """Draw a film into a folder, frame by frame, and return what `films.Films.state` says of it then."""
    stored = read_episode(cell, episode)
    ending = "webp" if features.check("webp") else "png"
    state: dict[str, Any] = {"state": "drawing", "ready": 0, "frames": 0, "every": every or 1, "ending": ending, "legend": []}
    if kind == BRANCHES:
        require_drawable(stored)
        from wasp_cli.video.replay import replay_step

        def tell(share: float, text: str) -> None:
            write_state(folder, {**state, "share": round(share, 3), "text": text})

        replay_step(layout, cell, episode, step, folder / f"00000.{ending}", tell)
        return {**state, "state": "done", "ready": 1, "frames": 1}
    images: Iterator[tuple[Image.Image, Legend]]
    if kind == REPLAY:
        require_drawable(stored)
        from wasp_cli.video.replay import replay_frames

        state["every"] = every or math.ceil(stored.decisions / REPLAYED)
        state["frames"] = math.ceil(stored.decisions / state["every"])
        images = ((Image.fromarray(frame), ()) for frame in replay_frames(layout, cell, episode, state["every"]))
    else:
        state["frames"] = math.ceil(stored.decisions / state["every"]) + 1
        images = film_frames(stored, state["every"])
    for number, (image, legend) in enumerate(images):
        part = folder / "frame.part"
        image.save(part, format=ending.upper(), **({"quality": QUALITY, "method": 2} if ending == "webp" else {}))
        part.replace(folder / f"{number:05d}.{ending}")
        state |= {"ready": number + 1, "legend": legend}
        write_state(folder, state)
    return {**state, "state": "done", "frames": state["ready"]}


def main(arguments: list[str], say: Callable[[str], Any] = print) -> int:
    """Draw what the arguments say; the exit code is 0 also where the film could not be drawn, and its state says why."""
    results, key, episode, kind, step, target, *rest = arguments
    folder = Path(target)
    os.nice(5)  # pages go first
    layout = Layout(Path(results))
    try:
        state = draw(layout, find_cell(layout, key), int(episode), kind, int(step), folder, int(rest[0]) if rest else None)
    except WaspError as error:
        state = {"state": "failed", "ready": 0, "frames": 0, "problem": problem_of(error)}
    except Exception as error:
        say(traceback.format_exc())
        problem = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        state = {"state": "failed", "ready": 0, "frames": 0, "problem": problem}
    write_state(folder, state)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
