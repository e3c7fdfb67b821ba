"""What the page draws of a world: numbers for a map, and the bytes of the cameras. Nothing here is an observation of an assistant."""

from __future__ import annotations

import base64
import io
from functools import cached_property
from typing import Any

import numpy as np
from PIL import Image

from wasp_cli.tasks.base import Observation, VectorTask
from wasp_cli.tasks.camera.appearance import HasScene, Scene, Things
from wasp_cli.tasks.camera.topdown import Shape, disc, draw_map, shapes_of
from wasp_cli.video.map import WIDEST, things_of

GROUND = 2048
"""Px of a side of the picture of the ground at most."""
FINE = 0.02
"""m of a pixel of it, where that is not too many."""
MARGIN = 1.5
"""The picture of the ground shows so many times the map's half side: one may drive off the map."""
_ROW = np.array([0])


class WorldView:
    """Numbers of a task's first row for a map that the page draws; of a task without a map nothing."""

    def __init__(self, task: VectorTask) -> None:
        self._task = task if isinstance(task, HasScene) else None

    @cached_property
    def still(self) -> dict[str, Any] | None:
        """What stays as it is: how large the map is, what is on it with colours and outlines, and the ground as a picture."""
        if self._task is None:
            return None
        appearance = self._task.appearance()
        colours = dict(things_of(appearance))
        kinds = [
            {
                "name": kind.name,
                "colour": colours[kind.name],
                "flat": kind.painted is not None,
                "shapes": [_outline(s) for s in ((disc(kind.column[0]),) if kind.column is not None else shapes_of(kind.geoms))],
            }
            for kind in appearance.kinds
        ]
        robot = [outline for part in appearance.robot for outline in map(_outline, shapes_of(part.geom))]
        whole = appearance.map_half_side <= WIDEST
        return {
            "half": min(appearance.map_half_side, WIDEST),
            "centre": list(appearance.map_centre or (0.0, 0.0)) if whole else None,
            "kinds": kinds,
            "robot": {
                "colour": colours.get("robot", "#c03030"),
                "shapes": robot,
                "front": round(float(np.arctan2(*appearance.forward[::-1])), 3),
            },
            "ground": self._ground(),
        }

    def _ground(self) -> dict[str, Any]:
        assert self._task is not None
        appearance, scene = self._task.appearance(), self._task.scene(_ROW)
        half = MARGIN * appearance.map_half_side
        centre = appearance.map_centre or (0.0, 0.0)
        nothing = {name: Things(t.position, t.rotation, np.zeros_like(t.shown)) for name, t in scene.things.items()}
        # The robot stands where the picture does not reach.
        empty = Scene(scene.position + 100.0 * half, scene.rotation, nothing)
        size = min(GROUND, round(2 * half / FINE))
        file = io.BytesIO()
        Image.fromarray(draw_map(appearance, empty, 0, size, (centre, half))).save(file, "WEBP", quality=80)
        return {"half": half, "centre": list(centre), "image": "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()}

    def now(self) -> dict[str, Any]:
        """Return where everything is: the robot as [x, y, direction of its front], things by kind as [x, y, direction], in m and rad."""
        if self._task is None:
            return {}
        appearance, scene = self._task.appearance(), self._task.scene(_ROW)
        front = scene.rotation[0, :2, :2] @ np.array(appearance.forward)
        at = scene.position[0, :2]
        things = {name: _places(of, at) for name, of in scene.things.items()}
        return {"robot": _short([*at, np.arctan2(front[1], front[0])]), "things": things}


def _places(things: Things, at: np.ndarray[Any, Any]) -> list[list[float]]:
    """[x, y, direction] of what is shown and near enough for a map around the robot."""
    position, rotation = things.position[0, :, :2], things.rotation[0]
    near = things.shown[0] & (np.abs(position - at).max(axis=1, initial=0.0) < 4 * WIDEST)
    yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    return [_short([*position[k], yaw[k]]) for k in np.flatnonzero(near)]


def _outline(shape: Shape) -> dict[str, Any]:
    return {
        "round": shape.round,
        "centre": _short(shape.centre),
        "half": _short(np.sqrt(shape.half.prod()) * np.ones(2) if shape.round else shape.half),
        "angle": round(float(np.arctan2(shape.axes[0, 1], shape.axes[0, 0])), 3),
    }


def _short(values: Any) -> list[float]:
    return [round(float(value), 3) for value in values]


def camera_bytes(observation: Observation) -> bytes:
    """Return the cameras of the first row as RGB, one below the other: [cameras * 64, 64, 3] uint8."""
    assert observation.pixels is not None
    images = observation.pixels[0].reshape(-1, 3, *observation.pixels.shape[-2:])
    return np.ascontiguousarray(np.moveaxis(images, 1, -1)).tobytes()
