"""What the page draws: a map as numbers, the bytes of the cameras or of a picture of the vector,
and what the assistant imagines as lines on the map.

The lines show where the command alone leads, and where its correction leads. Assistants observe
nothing of this.
"""

from __future__ import annotations

import base64
import io
import time
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from wasp_cli import seeds
from wasp_cli.learning.closed_loop import Filter
from wasp_cli.methods.base import Assistant, Decision, Parts
from wasp_cli.methods.configs import PrintedConfig, WASPConfig
from wasp_cli.metrics.episode import INTERVENED
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator
from wasp_cli.tasks.base import CAMERA_SIZE, Floats, Observation, VectorTask
from wasp_cli.tasks.camera.appearance import HasScene, Scene, Things
from wasp_cli.tasks.camera.topdown import Shape, disc, draw_map, shapes_of
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.pictures import picture_of
from wasp_cli.tasks.sight import seen_of
from wasp_cli.video.map import WIDEST, cameras_of, poses_of, things_of
from wasp_cli.video.picture import fitted
from wasp_cli.video.replay import HORIZON
from wasp_cli.video.trace import (
    Readout,
    displacements,
    fit,
    following,
    imagine,
    integrated,
    rollout_start,
)
from wasp_cli.video.vectors import Scale, draw_course

GROUND = 2048  # px of a side of the picture of the ground at most
FINE = 0.02  # m of a pixel of it, where that is not too many
# the picture of the ground shows so many times the map's half side: one may drive off the map
MARGIN = 1.5


class WorldView:
    """The first row of a task as numbers for the map that the page draws; empty for a task without
    a map.
    """

    def __init__(self, task: VectorTask) -> None:
        self._task = task if isinstance(task, HasScene) else None

    @property
    def still(self) -> dict[str, Any] | None:
        """What does not move: the size of the map, the kinds of things with their colours and
        outlines, and the ground as a picture. None without a map.
        """
        if self._task is None:
            return None
        appearance = self._task.appearance()
        colours = dict(things_of(appearance))
        kinds = []
        for kind in appearance.kinds:
            shapes = shapes_of(kind.geoms) if kind.column is None else (disc(kind.column[0]),)
            kinds.append(
                {
                    "name": kind.name,
                    "colour": colours[kind.name],
                    "flat": kind.painted is not None,
                    "shapes": [_outline(shape) for shape in shapes],
                }
            )
        forward_x, forward_y = appearance.forward
        robot = {
            "colour": colours.get("robot", "#c03030"),
            "front": round(float(np.arctan2(forward_y, forward_x)), 3),
            "shapes": [
                _outline(shape) for part in appearance.robot for shape in shapes_of(part.geom)
            ],
        }
        whole = appearance.map_half_side <= WIDEST
        return {
            "half": min(appearance.map_half_side, WIDEST),
            "centre": list(appearance.map_centre or (0.0, 0.0)) if whole else None,
            "kinds": kinds,
            "robot": robot,
            "ground": self._ground(),
        }

    def _ground(self) -> dict[str, Any]:
        assert self._task is not None
        appearance = self._task.appearance()
        scene = self._task.scene(np.array([0]))
        half = MARGIN * appearance.map_half_side
        centre = appearance.map_centre or (0.0, 0.0)
        nothing = {
            name: Things(t.position, t.rotation, np.zeros_like(t.shown))
            for name, t in scene.things.items()
        }
        # The robot is moved out of the picture.
        empty = Scene(scene.position + 100.0 * half, scene.rotation, nothing)
        size = min(GROUND, round(2 * half / FINE))
        file = io.BytesIO()
        Image.fromarray(draw_map(appearance, empty, 0, size, (centre, half))).save(
            file, "WEBP", quality=80
        )
        return {
            "half": half,
            "centre": list(centre),
            "image": "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode(),
        }

    def now(self) -> dict[str, Any]:
        """Return where everything is: the robot as [x, y, direction of its front], and the things
        near it by kind as [x, y, direction], in m and rad.
        """
        if self._task is None:
            return {}
        appearance = self._task.appearance()
        scene = self._task.scene(np.array([0]))
        robot = poses_of(appearance, scene)[0]
        things: dict[str, list[list[float]]] = {}
        for name, of_kind in scene.things.items():
            position = of_kind.position[0, :, :2]
            rotation = of_kind.rotation[0]
            # near enough to be on a map around the robot
            near = of_kind.shown[0] & (
                np.abs(position - robot[:2]).max(axis=1, initial=0.0) < 4 * WIDEST
            )
            yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
            things[name] = [short([*position[k], yaw[k]]) for k in np.flatnonzero(near)]
        return {"robot": short(robot), "things": things}


def _outline(shape: Shape) -> dict[str, Any]:
    half = np.sqrt(shape.half.prod()) * np.ones(2) if shape.round else shape.half
    angle = round(float(np.arctan2(shape.axes[0, 1], shape.axes[0, 0])), 3)
    return {
        "round": shape.round,
        "centre": short(shape.centre),
        "half": short(half),
        "angle": angle,
    }


def short(values: Any) -> list[float]:
    """Return numbers with three decimals, for JSON."""
    return [round(float(value), 3) for value in values]


PLOT = 320  # px of a side of the picture of a vector


class Eyes:
    """What assistants see of a task's first row, as a picture for the page: the cameras. Without
    cameras it is the picture that the task draws of itself, or else the components of its vector
    over time.
    """

    def __init__(self, task: VectorTask) -> None:
        self._task = task
        cameras = getattr(task, "cameras", 2)
        self._states: list[Floats] = []
        self._sees_vectors = cameras == 0
        self.said: dict[str, Any] = {"cameras": max(1, cameras), "side": CAMERA_SIZE}
        """How many pictures there are, one below the other, and their side in px."""
        if self._sees_vectors:
            task.reset([0])  # only in a world can be seen whether it draws itself
            draws = picture_of(task) is not None
            self.said = {"cameras": 1, "side": PLOT, "plot": True, "drawn": draws}

    def begin(self) -> None:
        """Forget the episode before."""
        self._states.clear()

    def look(self, observation: Observation) -> bytes:
        """Return the picture after the next decision as RGB, uint8 [cameras * side, side, 3]."""
        if not self._sees_vectors:
            return camera_bytes(observation)
        assert observation.state is not None
        self._states.append(observation.state[0].copy())
        drawn = picture_of(self._task)
        if drawn is not None:
            return np.asarray(fitted(drawn, PLOT)).tobytes()
        states = np.array(self._states)
        return np.asarray(draw_course(Scale.of(states), states, PLOT)).tobytes()


def camera_bytes(observation: Observation) -> bytes:
    """Return the cameras of the first row as RGB bytes, one below the other: uint8 [cameras * 64,
    64, 3].
    """
    assert observation.pixels is not None
    return cameras_of(observation.pixels[0]).tobytes()


# The expert's drive from which displacements are read out of latents.
WORLDS = 6
DECISIONS = 50  # in each of them
ROLE = "drive-readout"


class Futures:
    """Draws what the assistant imagines as lines; see the module. Nothing waits for it: if there is
    not enough time before the next decision, nothing is drawn.
    """

    def __init__(self, task: str, parts: Parts, assistant: Assistant, world: VectorTask) -> None:
        self._model = parts.world_model
        self._readout = _readout(task, parts, world)
        config: Any = getattr(assistant, "config", None)
        self._horizon = int(getattr(config, "horizon", HORIZON))
        self._hold = isinstance(config, PrintedConfig)
        # WASP imagines that the expert goes on after a command, other methods the operator.
        self._expert = None
        if isinstance(config, WASPConfig):
            self._expert = following(parts.skills.expert, world.action_size, 1)
        self._seconds = 0.0

    def lines(
        self,
        t: int,
        latent: Latent,
        a_h: Tensor,
        operator: Operator,
        decision: Decision,
        robot: list[float] | None,
        seconds: float,
    ) -> dict[str, Any] | None:
        """Imagine a decision, and return lines of [x, y] in m by name: `alone`, and `corrected` if
        there was a correction.

        Args:
            t: of the decision.
            latent: before it.
            a_h: the command [1, A].
            operator: who goes on commanding.
            decision: of the assistant.
            robot: [x, y, direction] before it.
            seconds: that are left.

        Returns:
            None if there is no map, or `seconds` was not enough for earlier ones.
        """
        if self._readout is None or robot is None or seconds < self._seconds:
            # The estimate decays, so that it is tried again after a time that was only disturbed.
            self._seconds *= 0.95
            return None
        begun = time.monotonic()
        with torch.inference_mode():
            residuals = _correction(a_h, decision)
            start = rollout_start(
                t,
                latent,
                0,
                a_h[0].cpu().numpy(),
                self._expert or operator,
                residuals,
                self._horizon,
            )
            imagined = imagine(self._model, start, self._horizon, (), hold=self._hold)
        ways = [
            integrated(np.array(robot), self._readout(features[0]))
            for features in imagined.features
        ]
        self._seconds = max(time.monotonic() - begun, 0.5 * self._seconds)
        # Without a correction there is only the first way.
        rounded = [np.round(way, 3).tolist() for way in ways]
        return dict(zip(("alone", "corrected"), rounded, strict=False))


def _correction(a_h: Tensor, decision: Decision) -> Any:
    """The residuals [L, A] of a decision; None if it does not change the command."""
    if decision.planned is not None:
        chosen = decision.planned.residuals[0].cpu().numpy()
        if np.isfinite(chosen).all() and np.abs(chosen).max() > 0:
            return chosen
        return None
    residual = (decision.action - a_h).cpu().numpy()
    if np.abs(residual).max() > INTERVENED:
        return residual
    return None


def _readout(task: str, parts: Parts, world: VectorTask) -> Readout | None:
    """Fit displacements of the robot to latents on a short drive of the expert; None of a task
    without a map.
    """
    if not isinstance(world, HasScene):
        return None
    worlds = make_task(task, WORLDS, action_repeat=world.action_repeat, observe=(seen_of(task),))
    assert isinstance(worlds, HasScene)
    filter_ = Filter(parts.world_model, WORLDS)
    seen = worlds.reset([seeds.derive(ROLE, task, row) for row in range(WORLDS)])
    first = torch.ones(WORLDS)
    everyone = np.arange(WORLDS)
    features: list[Any] = []
    poses: list[Floats] = []
    with torch.inference_mode():
        for _ in range(DECISIONS):
            latent = filter_.see(seen, first)
            features.append(latent.features.cpu().numpy().copy())
            poses.append(poses_of(worlds.appearance(), worlds.scene(everyone)))
            action = parts.skills.expert(latent.features).clamp(-1, 1)
            filter_.executed(action)
            step = worlds.step(action.cpu().numpy())
            seen = step.observation
            first = torch.zeros(WORLDS)
            if step.ended.any():
                break
    arrived = np.stack(features)[1:]
    places = np.stack(poses)
    return fit(
        [arrived[:, row] for row in range(WORLDS)],
        [displacements(places[:, row]) for row in range(WORLDS)],
    )
