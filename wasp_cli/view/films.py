"""Films on demand: drawn by a process of their own, frame by frame, and kept beside the store
until there is no room.
"""

from __future__ import annotations

import fcntl
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from PIL import Image

from wasp_cli.errors import ArtifactError, StoreError, UsageError, WaspError, described
from wasp_cli.report.explain.episode import Episode, read_episode
from wasp_cli.store.find import FoundCell, find_cell
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.lock import held, is_held
from wasp_cli.store.plain import open_plain, read_plain
from wasp_cli.store.records import read_record, write_record
from wasp_cli.tasks.registry import TASKS

FOLDER = ".wasp-view"
STATE = "film.json"
FILM = "film"
REPLAY = "replay"
BRANCHES = "branches"
"""From the physics alone; with cameras and imagined futures; both branches of one decision."""
KINDS = (FILM, REPLAY, BRANCHES)
# bytes of all films together, beyond which the ones that were drawn longest ago go
ROOM = 400 * 2**20
AT_ONCE = 2  # films that are drawn side by side
LARGEST = 32 * 2**20  # bytes of a frame
# the process that draws one film
DRAWS = "import sys; from wasp_cli.view.films import main; main(*sys.argv[1:])"
NOTHING: dict[str, Any] = {"ready": 0, "frames": 0}


class Films:
    """The films of a folder, each drawn by a process of its own into a folder of frames.

    Frames are kept in the results folder, or in a temporary one where that cannot be written; the
    oldest films go first where they need more than `room` bytes.
    """

    def __init__(self, layout: Layout, room: int = ROOM) -> None:
        self._layout = layout
        self._room = room
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
        # of all servers: two drew one film at once
        with self._lock, held(self.folder / "lock", lambda: True):
            state = self._state(name)
            if state["state"] in ("done", "drawing"):
                return state
            if sum(process.poll() is None for process in self._drawing.values()) >= AT_ONCE:
                return {**NOTHING, "state": "waiting"}
            self._make_room()
            folder = self.folder / name
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            with (folder / "log").open("wb") as log:
                with suppress(OSError):  # a file system without locks
                    # held by the process that has it for its output, until that ends
                    fcntl.flock(log, fcntl.LOCK_EX)
                command = drawing(self._layout, key, episode, kind, step, folder)
                environment = {**os.environ, "OMP_NUM_THREADS": "1"}
                self._drawing[name] = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment
                )
            return {**NOTHING, "state": "drawing"}

    def state(self, key: str, episode: int, kind: str, step: int = 0) -> dict[str, Any]:
        """Return `state`: absent, drawing, done, or failed, with `problem`; of a film also
        frames, ready ones, `every` and `legend`.
        """
        with self._lock:
            return self._state(_name(key, episode, kind, step))

    def frame(self, key: str, episode: int, kind: str, number: int, step: int = 0) -> bytes | None:
        """Return a frame as WebP; None where it is not there."""
        with (
            suppress(OSError),
            open_plain(self.folder / _name(key, episode, kind, step) / frame_name(number)) as file,
        ):
            return file.read(LARGEST)
        return None

    def close(self) -> None:
        """End the processes that draw, and remove what they left."""
        with self._lock:
            for name, process in self._drawing.items():
                if process.poll() is None:
                    process.kill()
                    process.wait()
                    shutil.rmtree(self.folder / name, ignore_errors=True)
        if self._own is not None:
            self._own.cleanup()

    def _is_drawn(self, name: str) -> bool:
        """Whether a film is being drawn, by this server or by another one on the same results."""
        process = self._drawing.get(name)
        with suppress(OSError):
            return (process is not None and process.poll() is None) or is_held(
                self.folder / name / "log"
            )
        return False

    def _state(self, name: str) -> dict[str, Any]:
        folder = self.folder / name
        process = self._drawing.get(name)
        drawn = self._is_drawn(name)
        record = read_state(folder)  # after its process was asked: what that said last is there
        if record is not None and record["state"] != "drawing":
            return record
        if drawn:
            return record or {**NOTHING, "state": "drawing"}
        if process is None:
            return {**NOTHING, "state": "absent"}  # also of a server that was killed
        lines: list[str] = []
        with suppress(OSError, ValueError):
            lines = [line for line in read_plain(folder / "log").splitlines() if line.strip()]
        return {
            **NOTHING,
            "state": "failed",
            "problem": lines[-1][:500] if lines else f"its process ended ({process.poll()})",
        }

    def _make_room(self) -> None:
        films = []
        for folder in self.folder.iterdir():
            if not folder.is_symlink() and folder.is_dir() and not self._is_drawn(folder.name):
                films.append(
                    (
                        folder.lstat().st_mtime_ns,
                        sum(path.lstat().st_size for path in folder.iterdir()),
                        folder,
                    )
                )
        total = sum(size for _, size, _ in films)
        for _, size, folder in sorted(films):
            if total > self._room:
                shutil.rmtree(folder, ignore_errors=True)
                total -= size


def drawing(
    layout: Layout, key: str, episode: int, kind: str, step: int, folder: Path, every: int = 0
) -> list[str]:
    """Return the command of the process that draws a film into a folder."""
    # -P: the working directory may be the results themselves: their modules are not ours.
    return [
        sys.executable,
        "-P",
        "-c",
        DRAWS,
        *map(str, (layout.root.absolute(), key, episode, kind, step, folder, every)),
    ]


def frame_name(number: int) -> str:
    """Return the file of a frame in the folder of a film."""
    return f"{number:05d}.webp"


def read_state(folder: Path) -> dict[str, Any] | None:
    """Return what the drawing process says; None before it has said anything, or where that
    does not read.
    """
    with suppress(ArtifactError):
        record = read_record(folder / STATE)
        return record if record is not None and isinstance(record.get("state"), str) else None
    return None


def _name(key: str, episode: int, kind: str, step: int) -> str:
    if not is_key(key) or kind not in KINDS or episode < 0 or step < 0:
        raise UsageError("there is no such film")
    return f"{key}-{episode}-{kind}" + (f"-{step}" if kind == BRANCHES else "")


def problem_of(error: WaspError) -> str:
    """Return an error in one line, with its hint."""
    return error.message + (f" ({error.hint})" if error.hint else "")


SIZE = 420  # side of the map in px
CAMERA = 206  # of a camera image
GAP = 8  # between them
QUALITY = 72
REPLAYED = 125  # frames at most of a film with imagined futures, which take long to draw
Legend = tuple[tuple[str, str, str], ...]  # what a map shows: name, colour and meaning of each


def _require_drawable(stored: Episode) -> int:
    task = str(stored.row["task"])
    repeat = stored.constants.action_repeat
    if task not in TASKS:
        raise UsageError(
            f"'{task}' is no task of ours: drawing it would run a module that these results name",
            "wasp replay does so",
        )
    if repeat is None or not 0 < repeat <= TASKS[task].env_steps:
        raise UsageError("its manifest does not say how long a decision is")
    return repeat


def _film_frames(stored: Episode, every: int) -> Iterator[tuple[Image.Image, Legend]]:
    from wasp_cli.video.film import film
    from wasp_cli.video.map import legend_of

    repeat = _require_drawable(stored)
    row = stored.row
    seed = int(row["episode_seed"])
    rewards = stored.numbers["reward"]
    for moment in film(
        str(row["task"]), repeat, seed, stored.a, stored.a_h, rewards, every, SIZE, cameras=True
    ):
        image = Image.new("RGB", (SIZE + GAP + CAMERA, SIZE), (255, 255, 255))
        image.paste(Image.fromarray(moment.frame), (0, 0))
        for place, seen in enumerate((moment.seen if moment.seen is not None else ())[:2]):
            side = Image.fromarray(seen).resize((CAMERA, CAMERA), Image.Resampling.NEAREST)
            image.paste(side, (SIZE + GAP, place * (CAMERA + GAP)))
        yield image, legend_of(moment.things)


def draw(
    layout: Layout,
    cell: FoundCell,
    episode: int,
    kind: str,
    step: int,
    folder: Path,
    every: int = 0,
) -> dict[str, Any]:
    """Draw all frames of a film into a folder; returns its state, as `Films.state`.

    Args:
        layout: of the results folder.
        cell: whose episode it is.
        episode: its number.
        kind: FILM, REPLAY (with imagined futures) or BRANCHES (one picture of both branches).
        step: the branched decision; of BRANCHES alone.
        folder: which exists.
        every: decisions from one frame to the next; 0: as fits.

    Raises:
        UsageError: the task is none of ours, or the decision was not branched.
        StoreError, ArtifactError: the rows or the models cannot be read.
    """
    stored = read_episode(cell, episode)
    state: dict[str, Any] = {**NOTHING, "state": "drawing", "every": every or 1, "legend": []}
    if kind != FILM:
        _require_drawable(stored)
    if kind == BRANCHES:
        from wasp_cli.video.replay import replay_step

        def tell(share: float, text: str) -> None:
            write_record(folder / STATE, {**state, "share": round(share, 3), "text": text})

        replay_step(layout, cell, episode, step, folder / frame_name(0), tell)
        return {**state, "state": "done", "ready": 1, "frames": 1}
    images: Iterator[tuple[Image.Image, Legend]]
    if kind == REPLAY:
        from wasp_cli.video.replay import replay_frames

        state["every"] = every or math.ceil(stored.decisions / REPLAYED)
        images = (
            (Image.fromarray(frame), ())
            for frame in replay_frames(layout, cell, episode, state["every"])
        )
    else:
        images = _film_frames(stored, state["every"])
    # which also shows where the last decision led
    state["frames"] = math.ceil(stored.decisions / state["every"]) + (kind == FILM)
    for number, (image, legend) in enumerate(images):
        part = folder / "frame.part"
        image.save(part, format="WEBP", quality=QUALITY, method=2)
        part.replace(folder / frame_name(number))
        state.update(ready=number + 1, legend=legend)
        write_record(folder / STATE, state)
    return {**state, "state": "done", "frames": state["ready"]}


def main(
    results: str, key: str, episode: str, kind: str, step: str, target: str, every: str
) -> None:
    """Draw a film, as the process of `drawing`; what goes wrong becomes the state of the film."""
    os.nice(5)  # pages go first
    layout = Layout(Path(results))
    folder = Path(target)
    try:
        state = draw(
            layout, find_cell(layout, key), int(episode), kind, int(step), folder, int(every)
        )
    except WaspError as error:
        state = {**NOTHING, "state": "failed", "problem": problem_of(error)}
    except Exception as error:
        print(traceback.format_exc())
        state = {**NOTHING, "state": "failed", "problem": described(error)[:300]}
    write_record(folder / STATE, state)
