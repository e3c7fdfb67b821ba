"""The two counterfactual branches of one decision, side by side on the map: as it was executed, and
as it was commanded.

Both then follow the operator alone (`learning.counterfactual`). A branch has at most W decisions,
and w < W if its episode ended early.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from wasp_cli.learning.counterfactual import Branch, branches
from wasp_cli.learning.rerun import Rerun
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.models.world_model import load_world_model
from wasp_cli.tasks.base import Floats, Observation, Pixels, Step, VectorTask
from wasp_cli.tasks.camera.appearance import Appearance, HasScene, Scene
from wasp_cli.tasks.pictures import picture_of
from wasp_cli.video.film import STILL, write
from wasp_cli.video.map import (
    COMMAND,
    COST,
    EXECUTED,
    WIDEST,
    MapPicture,
    along,
    cameras_of,
    draw_actions,
    font,
    poses_of,
)
from wasp_cli.video.picture import fitted, outline
from wasp_cli.video.trace import Progress, Source, threads_of_evaluations
from wasp_cli.video.vectors import Curves, Scale, draw_curves, mark_cost

MAP = 420
GAP = 14
HEADER = 36
TITLE = 20
BARS = 62
"""In px: the side of a map, the gap between panels, and the heights of the first line, a title and
the bars below a map.
"""
# half the side of the maps in m at least, and how much more than both paths they show
NARROWEST = 0.8
ROOM = 1.35
MS = 320  # that a frame is shown
LAST_MS = 2500  # that the last one is shown
_INK = (20, 20, 20)
_GREY = (105, 105, 105)
_PAPER = (255, 255, 255)
_NOTHING = (236, 236, 236)
_NAMES = {ASSISTED: "as executed", ALONE: "command alone"}
_COLOURS = {ASSISTED: EXECUTED, ALONE: COMMAND}


@dataclass
class _BranchStates:
    """What one branch shows: w + 1 states, and the w actions between them."""

    # what assistants see: images [6, 64, 64], or vectors [S]
    seen: list[NDArray[Any]] = field(default_factory=list)
    scenes: list[Scene] = field(default_factory=list)
    # what the task draws of itself, where it does
    pictures: list[Pixels] = field(default_factory=list)
    actions: list[Floats] = field(default_factory=list)


class _RecordingTask:
    """A task that keeps what one of its rows shows after every restore and step. A restore begins a
    branch.
    """

    def __init__(self, task: VectorTask, row: int) -> None:
        self._task = task
        self._row = row
        self.branches: list[_BranchStates] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._task, name)

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> Observation:
        observation = self._task.restore(snapshot)
        self.branches.append(_BranchStates())
        self._keep(observation)
        return observation

    def step(self, action: NDArray[Any]) -> Step:
        step = self._task.step(action)
        if self.branches:
            self.branches[-1].actions.append(np.array(action[self._row], np.float64))
            self._keep(step.observation)
        return step

    def _keep(self, observation: Observation) -> None:
        seen = observation.state if observation.pixels is None else observation.pixels
        assert seen is not None
        self.branches[-1].seen.append(seen[self._row].copy())
        if isinstance(self._task, HasScene):
            self.branches[-1].scenes.append(self._task.scene(np.array([self._row])))
        picture = picture_of(self._task, self._row)
        if picture is not None:
            self.branches[-1].pictures.append(picture)


class BranchPair:
    """Both branches of decision `t` of an episode, played over at most `window` decisions."""

    def __init__(
        self, source: Source, episode: int, t: int, window: int, progress: Progress
    ) -> None:
        with threads_of_evaluations():
            world = source.world()
            recording = _RecordingTask(world, episode)
            model = load_world_model(source.world_model)
            rerun = Rerun(
                recording,
                model,
                source.operator_in(world),
                source.recorded,
            )
            played = branches(
                rerun, [[t] if e == episode else [] for e in range(world.batch)], window, progress
            )
        self.world = world
        self.t = t
        self.window = window
        self._sees_vectors = model.reads == "state"
        self.appearance: Appearance | None = (
            world.appearance() if isinstance(world, HasScene) else None
        )
        self.branches: Mapping[str, Branch] = {branch.name: branch for branch in played}
        self._states = dict(zip((ASSISTED, ALONE), recording.branches, strict=True))

    def film(self, title: str, verdict: Sequence[str], out: Path) -> None:
        """Write both branches as an animation, or their last frame as a still picture
        (`film.STILL`).

        Args:
            title: above the maps.
            verdict: lines below them.
            out: the file.
        """
        last = max(len(branch.cost) for branch in self.branches.values())
        if out.suffix.lower() in STILL:
            self._frame(last, title, verdict).save(out, format="PNG")
            return
        write(
            out,
            last + 1,
            lambda step: self._frame(step, title, verdict),
            [*[MS] * last, LAST_MS],
            lambda index: None,
        )

    def _frame(self, step: int, title: str, verdict: Sequence[str]) -> Image.Image:
        width = 2 * MAP + 3 * GAP
        image = Image.new(
            "RGB", (width, HEADER + TITLE + MAP + BARS + 20 * len(verdict) + 8), _PAPER
        )
        draw = ImageDraw.Draw(image)
        draw.text((GAP, 9), title, _INK, font(15, True))
        time = f"{step} of {self.window} decisions later"
        draw.text((width - GAP - font(14).getlength(time), 10), time, _INK, font(14))
        for column, name in enumerate((ASSISTED, ALONE)):
            x = GAP + column * (MAP + GAP)
            states = self._states[name]
            action = ", ".join(f"{part:+.2f}" for part in states.actions[0])
            draw.rectangle((x, HEADER + 4, x + 10, HEADER + 14), _COLOURS[name])
            draw.text(
                (x + 16, HEADER + 1),
                f"{_NAMES[name]}: ({action}), then the operator",
                _INK,
                font(12),
            )
            image.paste(self._state(name, step), (x, HEADER + TITLE))
            if self.appearance is None:
                outline(image, (x, HEADER + TITLE), MAP)
            self._bars(draw, x, HEADER + TITLE + MAP + 6, self.branches[name], step)
        for row, line in enumerate(verdict):
            draw.text((GAP, HEADER + TITLE + MAP + BARS + 20 * row), line, _INK, font(13))
        return image

    def _state(self, name: str, step: int) -> Image.Image:
        states = self._states[name]
        now = min(step, len(states.actions))
        if len(states.pictures) > now:
            square = fitted(states.pictures[now], MAP)
            if now and self.branches[name].cost[now - 1]:
                mark_cost(square, 4)
            return square
        # Without a map: the components of the vector so far, or the front camera.
        if self.appearance is None and self._sees_vectors:
            whole = np.concatenate([np.array(each.seen) for each in self._states.values()])
            course = Curves(np.array(states.seen[: now + 1]), 0, _COLOURS[name])
            after = np.flatnonzero(self.branches[name].cost[:now]) + 1
            span = (0, self.window)
            return draw_curves(Scale.of(whole), [course], span, (MAP, MAP), costly=after.tolist())
        if self.appearance is None:
            return Image.fromarray(cameras_of(states.seen[now])[0]).resize(
                (MAP, MAP), Image.Resampling.BICUBIC
            )

        # The map, with both paths, costs and the next action.
        paths = {
            branch: along([scene.position[0, :2] for scene in passed.scenes])
            for branch, passed in self._states.items()
        }
        picture = MapPicture.of(
            self.appearance, states.scenes[now], MAP, *_window(list(paths.values()))
        )
        other = ALONE if name == ASSISTED else ASSISTED
        picture.line(paths[other][: step + 1], _COLOURS[other] + "60", 2.0)
        picture.line(paths[name][: now + 1], "#FFFFFFB0", 5.0)
        picture.line(paths[name][: now + 1], _COLOURS[name], 2.6)
        paid = np.flatnonzero(self.branches[name].cost[:now])
        picture.dots(paths[name][paid + 1], COST, 5.0, "#FFFFFF")
        if now < len(states.actions):
            action = states.actions[now]
            # Only the first action of the branch as executed differs from the command.
            command = action
            if name == ASSISTED and now == 0:
                command = self._states[ALONE].actions[0]
            pose = poses_of(self.appearance, states.scenes[now])[0]
            draw_actions(picture, self.world, pose, command, action, 4)
        return picture.finished()

    def _bars(self, draw: ImageDraw.ImageDraw, x: int, y: int, branch: Branch, step: int) -> None:
        """A box per decision, filled where cost was paid, and the sums so far."""
        side = MAP / self.window
        for w in range(self.window):
            fill: str | tuple[int, int, int] = _NOTHING  # still to come
            if w < step:
                fill = _PAPER if w < len(branch.cost) else _GREY
                if w < len(branch.cost) and branch.cost[w]:
                    fill = COST
            draw.rectangle((x + w * side, y, x + (w + 1) * side - 3, y + 14), fill, _GREY)
        ended = ""
        if len(branch.cost) <= step and len(branch.cost) < self.window:
            ended = "   (the episode has ended)"
        costs = branch.cost[:step].sum()
        rewards = branch.reward[:step].sum()
        draw.text(
            (x, y + 22), f"costly decisions {costs}    reward {rewards:+.3f}{ended}", _INK, font(13)
        )


def _window(paths: Sequence[Floats]) -> tuple[Floats, float]:
    """Centre [2] and half side of a map that shows all of some paths, in m."""
    places = np.concatenate(list(paths))
    low = places.min(0)
    high = places.max(0)
    return (low + high) / 2.0, float(
        np.clip(ROOM * (high - low).max() / 2.0 + 0.2, NARROWEST, WIDEST)
    )
