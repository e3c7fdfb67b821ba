"""The rays of both cameras, and one image pair while it is drawn. P = 2 * 64 * 64 pixels, front
image first; m = some of them.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import CAMERA_SIZE, Floats
from wasp_cli.tasks.camera.appearance import Appearance, Colour, Scene, Shades

FRONT_SLOPE = 0.4
"""The front camera looks down by this slope (21.8 degrees), the rear camera is level; both have
90 degrees field of view.
"""

FAR = 300.0  # depth of the sky in m: nothing that is farther away is drawn


class Cast(NamedTuple):
    """What rays have hit."""

    distance: Floats  # [m] in m; -1: nothing
    normals: Floats  # [m, 3] unit vectors
    geoms: NDArray[np.int32]  # [m] ids of geoms; -1: nothing


class View(NamedTuple):
    """What is constant in the robot's frame. Every image of a robot starts from it."""

    axes: Floats  # [2, 3, 3] for each camera its forward, right and up unit vectors
    rays: Shades  # [3, P] unit vectors
    depth: Shades  # [P] distance to the robot's own body, FAR where it is out of sight
    own: NDArray[np.intp]  # [O] the pixels that show the robot's own body
    own_colour: Shades  # [3, O]


def camera_axes(forward: tuple[float, float], slope: float) -> Floats:
    """Return unit vectors [3, 3] forward, right and up of a camera that looks along `forward`
    and down by `slope` (a tangent).
    """
    level2 = forward[0] ** 2 + forward[1] ** 2
    ahead = np.array([*forward, -slope]) / np.sqrt(level2 + slope**2)
    right = np.array([forward[1], -forward[0], 0.0]) / np.sqrt(level2)
    return np.stack([ahead, right, np.cross(right, ahead)])


def camera_rays(axes: Floats) -> Floats:
    """Return unit vectors [64 * 64, 3] through the pixel centres of a camera, `axes` [3, 3], 90
    degrees field of view, top row first.
    """
    forward, right, up = axes
    at = (np.arange(CAMERA_SIZE) + 0.5) / (CAMERA_SIZE / 2) - 1.0
    rays = (forward + at[None, :, None] * right - at[:, None, None] * up).reshape(-1, 3)
    x, y, z = rays.T
    unit: Floats = rays / np.sqrt(x * x + y * y + z * z)[:, None]
    return unit


def make_view(appearance: Appearance) -> View:
    """Cast all rays once at the robot itself."""
    fx, fy = appearance.forward
    axes = np.stack([camera_axes((fx, fy), FRONT_SLOPE), camera_axes((-fx, -fy), 0.0)])
    # Rounded first, so that the last bit of a machine's square root or cross product cannot reach
    # an image.
    rays = rounded(np.concatenate([camera_rays(each) for each in axes]))
    geoms = "".join(part.geom for part in appearance.robot)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    hit = cast(model, data, np.array([0.0, 0.0, appearance.camera_height]), rays)
    # The pixels that show the robot, and what they show.
    own = np.flatnonzero(hit.geoms >= 0)
    colours = np.array([part.colour for part in appearance.robot], np.float32)
    depth = np.full(len(rays), FAR, np.float32)
    depth[own] = hit.distance[own]
    own_colour = colours[hit.geoms[own]].T * shade(hit.normals[own], rays[own])
    return View(axes, np.ascontiguousarray(rays.T, np.float32), depth, own, own_colour)


def cast(model: mujoco.MjModel, data: mujoco.MjData, origin: Floats, rays: Floats) -> Cast:
    """Cast rays from `origin` [3] along unit vectors `rays` [m, 3], at most `FAR` m long."""
    count = len(rays)
    distance = np.full(count, -1.0)
    normal = np.zeros(3 * count)
    geoms = np.full(count, -1, np.int32)
    if count:
        mujoco.mj_multiRay(
            model,
            data,
            origin,
            rays.reshape(-1),
            None,
            True,
            -1,
            geoms,
            distance,
            normal,
            count,
            FAR,
        )
    return Cast(distance, normal.reshape(-1, 3), geoms)


def shade(normals: Floats, rays: Floats) -> Shades:
    """Return brightness [m] in [0.45, 1] of `normals` [m, 3] seen along `rays` [m, 3]: a light
    straight above and one at the camera.
    """
    facing = np.abs(
        normals[:, 0] * rays[:, 0] + normals[:, 1] * rays[:, 1] + normals[:, 2] * rays[:, 2]
    )
    bright = 0.45 + 0.3 * np.maximum(normals[:, 2], 0.0) + 0.25 * facing
    return np.asarray(bright, np.float32)


_LOWEST = 0.02  # height in m below which no camera sinks, even that of a car on its back


class Poses(NamedTuple):
    """Where the cameras of n rows are."""

    origin: Floats  # [n, 3] where both cameras are
    turn: Floats  # [n, 3, 3] robot body to world
    axes: Floats  # [n, 2, 3, 3] for each camera its forward, right and up unit vectors


def camera_poses(view: View, camera_height: float, scene: Scene) -> Poses:
    """Place the cameras (`camera_height` in m) of every row of a scene."""
    turn = rounded(scene.rotation)
    origin = rounded(scene.position) + turn[:, :, 2] * camera_height
    np.maximum(origin[:, 2], _LOWEST, out=origin[:, 2])
    x, y, z = np.moveaxis(turn[:, None, None], -1, 0)
    axes = view.axes[..., 0, None] * x + view.axes[..., 1, None] * y + view.axes[..., 2, None] * z
    return Poses(origin, turn, axes)


class Frame(NamedTuple):
    """The cameras in the world, and what was drawn so far."""

    origin: Floats  # [3] where both cameras are
    turn: Shades  # [3, 3] robot body to world
    body_rays: Shades  # [3, P] unit vectors in the robot's frame
    depth: Shades  # [P] distance in m of what is seen; FAR in the sky
    image: Shades  # [3, P] in [0, 1]; nothing is in it at first

    def rays(self, pixels: NDArray[np.intp] | None = None) -> Shades:
        """Return unit vectors [3, m] in the world through these pixels, or [3, P] through all."""
        rays = self.body_rays
        if pixels is not None:
            rays = np.take(rays, pixels, axis=1)
        return turned_rays(self.turn, rays)

    def put(self, pixels: NDArray[np.intp], colours: Shades) -> None:
        """Enter colours [3, m] at pixels [m]."""
        put(self.image, pixels, colours)


def open_frame(view: View, poses: Poses, row: int) -> Frame:
    """Begin one row; nothing is drawn yet but the depth of the robot's own body."""
    return Frame(
        origin=poses.origin[row],
        turn=poses.turn[row].astype(np.float32),
        body_rays=view.rays,
        depth=view.depth.copy(),
        image=np.empty_like(view.rays),
    )


def turned_rays(turn: Shades, rays: Shades) -> Shades:
    """Turn `rays` [3, m] from the robot's frame into the world by `turn` [k, 3], its first k
    rows -> [k, m].
    """
    # Summed in a fixed order, so that every machine gets the same bits.
    x, y, z = turn.T[:, :, None]
    turned: Shades = x * rays[0]
    turned += y * rays[1]
    turned += z * rays[2]
    return turned


def put(image: Shades, pixels: NDArray[np.intp], colours: Shades) -> None:
    """Enter colours [3, m] at pixels [m] of an image: by channel, which is three times as fast
    as an assignment to all of them.
    """
    for channel, colour in zip(image, colours, strict=True):
        channel[pixels] = colour


def rounded(values: Floats) -> Floats:
    """Round to float32 and back, any shape: differences of the last bits between machines are
    gone, the arithmetic stays in float64.
    """
    return values.astype(np.float32).astype(np.float64)


def column(rgb: Colour) -> Shades:
    """Return a colour as float32 [3, 1]."""
    return np.array(rgb, np.float32)[:, None]
