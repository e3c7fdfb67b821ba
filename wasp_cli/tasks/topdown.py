"""A map of Goal1 from above, for videos and figures. Plain numpy; nothing in it is an observation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks import goal1_model as g1
from wasp_cli.tasks.base import Floats, Pixels
from wasp_cli.tasks.camera import (
    ARROW_COLOUR,
    GOAL_COLOUR,
    HAZARD_COLOUR,
    SPHERE_COLOUR,
    TILE_DARK,
    TILE_LIGHT,
    TILE_SIDE,
    VASE_COLOUR,
    Scene,
)

HALF_SIDE = 2.0
"""Half the side of the map in m. The map follows an agent that leaves it."""


def draw_map(scene: Scene, row: int, size: int) -> Pixels:
    """uint8 [size, size, 3] of one row, +x to the right, +y up."""
    agent = scene.agent_xy[row]
    centre = agent - np.clip(agent, -(HALF_SIDE - 0.2), HALF_SIDE - 0.2)
    at = ((np.arange(size) + 0.5) / size * 2.0 - 1.0) * HALF_SIDE
    x, y = np.meshgrid(centre[0] + at, centre[1] - at)

    odd = (np.floor(x / TILE_SIDE) + np.floor(y / TILE_SIDE)) % 2 > 0
    image = np.where(odd[..., None], TILE_DARK, TILE_LIGHT)
    for hazard in scene.hazards_xy[row]:
        _paint(image, _disc(x, y, hazard, g1.HAZARD_RADIUS), HAZARD_COLOUR, 0.45)
    _paint(image, _disc(x, y, scene.goal_xy[row], g1.GOAL_RADIUS), GOAL_COLOUR, 0.45)
    w, qx, qy, z = scene.vase[row, 3:7].tolist()
    vase_yaw = math.atan2(2.0 * (w * z + qx * qy), 1.0 - 2.0 * (qy * qy + z * z))
    _paint(image, _square(x, y, scene.vase[row, :2], vase_yaw, g1.VASE_HALF), VASE_COLOUR, 1.0)
    yaw = float(scene.agent_yaw[row])
    _paint(image, _disc(x, y, agent, g1.AGENT_RADIUS), SPHERE_COLOUR, 1.0)
    nose = agent + g1.ARROW_X * np.array([math.cos(yaw), math.sin(yaw)])
    _paint(image, _square(x, y, nose, yaw, g1.ARROW_HALF), ARROW_COLOUR, 1.0)
    out: Pixels = (image * 255.0 + 0.5).astype(np.uint8)
    return out


def _paint(image: Floats, where: NDArray[np.bool_], colour: tuple[float, float, float], alpha: float) -> None:
    image[where] = (1.0 - alpha) * image[where] + alpha * np.array(colour)


def _disc(x: Floats, y: Floats, centre: Floats, radius: float) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2
    return inside


def _square(x: Floats, y: Floats, centre: Floats, yaw: float, half: float) -> NDArray[np.bool_]:
    dx, dy = x - centre[0], y - centre[1]
    along, across = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
    inside: NDArray[np.bool_] = np.maximum(np.abs(along), np.abs(across)) < half
    return inside
