"""Films on demand: drawn by a process of their own, frame by frame, and kept beside the store until there is no room.

films = Films(Layout(Path("results")))
films.ask(key, 3, FILM)        begins to draw, where nobody has; returns how far it is
films.frame(key, 3, FILM, 17)  the bytes of a frame, None while it is not there
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from PIL import Image, features

from wasp_cli.errors import StoreError, UsageError, WaspError
from wasp_cli.report.explain.episode import Episode, read_episode
from wasp_cli.store.find import FoundCell, find_cell
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.plain import open_plain, parse, read_plain
from wasp_cli.tasks.registry import TASKS

FOLDER = ".wasp-view"
FILM, REPLAY, BRANCHES = "film", "replay", "branches"
"""From the physics alone; with cameras and imagined futures; both branches of one decision."""
KINDS = (FILM, REPLAY, BRANCHES)
ROOM = 400 * 2**20  # bytes of all films together, beyond which the ones that were asked for longest ago go
AT_ONCE = 2  # films that are drawn side by side
LARGEST = 32 * 2**20  # bytes of a frame
DRAWS = "import sys; from wasp_cli.view.films import main; sys.exit(main(sys.argv[1:]))"  # the process that draws one film
MIME = {"webp": "image/webp", "png": "image/png"}


class Films:
    """The films of a results folder."""

    def __init__(self, layout: Layout, room: int = ROOM) -> None:
        """Use a folder within the results, or one of our own where these cannot be written."""
        self._layout, self._room = layout, room
        self._lock = threading.Lock()
        self._drawing: dict[str, subprocess.Popen[bytes]] = {}
        self._own: tempfile.TemporaryDirectory[str] | None = None
        self.folder = layout.root / FOLDER / "films"
        try:
            layout.within(self.folder).mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.folder):
                pass
        except (OSError, StoreError):
            self._own = tempfile.TemporaryDirectory(prefix="wasp-view-")
            self.folder = Path(self._own.name)

    def ask(self, key: str, episode: int, kind: str, step: int = 0) -> dict[str, Any]:
        """Begin a film unless it is there or being drawn; return how far it is, see `state`."""
        name = _name(key, episode, kind, step)
        with self._lock:
            self._reap()
            state = self._state(name)
            if state["state"] in ("done", "drawing"):
                return state
            if len(self._drawing) >= AT_ONCE:
                return {"state": "waiting", "ready": 0, "frames": 0}
            self._tidy()
            folder = self.folder / name
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            command = drawing(self._layout, key, episode, kind, step, folder)
            with (folder / "log").open("wb") as log:
                environment = {**os.environ, "OMP_NUM_THREADS": "1"}
                self._drawing[name] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)
            return {"state": "drawing", "ready": 0, "frames": 0}

    def state(self, key: str, episode: int, kind: str, step: int = 0) -> dict[str, Any]:
        """Return how far a film is.

        `state` is absent, drawing, done, or failed, with `problem`; of a film that is begun `frames`, `ready` of them, decisions between
        two (`every`), `ending` of the files and `legend`.
        """
        with self._lock:
            self._reap()
            return self._state(_name(key, episode, kind, step))

    def frame(self, key: str, episode: int, kind: str, number: int, step: int = 0) -> tuple[bytes, str] | None:
        """Return a frame and its MIME type; None where it is not there."""
        folder = self.folder / _name(key, episode, kind, step)
        for ending, mime in MIME.items():
            try:
                with open_plain(folder / f"{number:05d}.{ending}") as file:
                    return file.read(LARGEST), mime
            except OSError:
                continue
        return None

    def close(self) -> None:
        """Stop drawing."""
        with self._lock:
            for name, process in self._drawing.items():
                process.kill()
                process.wait()
                shutil.rmtree(self.folder / name, ignore_errors=True)
            self._drawing.clear()
        if self._own is not None:
            self._own.cleanup()

    def _state(self, name: str) -> dict[str, Any]:
        record = read_state(self.folder / name)
        if record is None:
            return {"state": "drawing" if name in self._drawing else "absent", "ready": 0, "frames": 0}
        if record["state"] == "drawing" and name not in self._drawing:
            return {"state": "absent", "ready": 0, "frames": 0}  # of a server that was killed
        return record

    def _reap(self) -> None:
        for name, process in list(self._drawing.items()):
            if process.poll() is not None:
                del self._drawing[name]
                folder = self.folder / name
                record = read_state(folder)
                if record is None or record["state"] == "drawing":
                    why = _last_line(folder / "log") or f"its process ended ({process.returncode})"
                    write_state(folder, {"state": "failed", "ready": 0, "frames": 0, "problem": why})

    def _tidy(self) -> None:
        """Make room: the films that were written longest ago go first."""
        films = []
        for folder in self.folder.iterdir():
            if folder.is_symlink() or not folder.is_dir() or folder.name in self._drawing:
                continue
            sizes = [path.lstat().st_size for path in folder.iterdir()]
            films.append((folder.lstat().st_mtime_ns, sum(sizes), folder))
        total = sum(size for _, size, _ in films)
        for _, size, folder in sorted(films):
            if total <= self._room:
                break
            shutil.rmtree(folder, ignore_errors=True)
            total -= size


def drawing(layout: Layout, key: str, episode: int, kind: str, step: int, folder: Path, every: int | None = None) -> list[str]:
    """Return the command that draws a film into a folder (see `main`)."""
    # -P: the working directory may be the results themselves: their modules are not ours.
    places = (layout.root.absolute(), key, episode, kind, step, folder, *(() if every is None else (every,)))
    return [sys.executable, "-P", "-c", DRAWS, *map(str, places)]


def read_state(folder: Path) -> dict[str, Any] | None:
    """Return what the drawing process says; None before it has said anything, or where that does not read."""
    try:
        record = parse(read_plain(folder / "film.json"))
    except (OSError, ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and isinstance(record.get("state"), str) else None


def write_state(folder: Path, record: dict[str, Any]) -> None:
    """Write what there is to say of a film; readers see the old words or the new ones."""
    part = folder / "film.json.part"
    part.write_text(json.dumps(record), encoding="utf-8")
    part.replace(folder / "film.json")


def _name(key: str, episode: int, kind: str, step: int) -> str:
    if not is_key(key) or kind not in KINDS or episode < 0 or step < 0:
        raise UsageError("there is no such film")
    return f"{key}-{episode}-{kind}" + (f"-{step}" if kind == BRANCHES else "")


def _last_line(path: Path) -> str:
    try:
        lines = [line for line in read_plain(path).splitlines() if line.strip()]
    except (OSError, ValueError):
        return ""
    return lines[-1][:500] if lines else ""


def problem_of(error: WaspError) -> str:
    """Return an error and what to do about it in one text."""
    return error.message + (f" ({error.hint})" if error.hint else "")


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
    """Draw a film into a folder, frame by frame, and return what `Films.state` says of it then."""
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
