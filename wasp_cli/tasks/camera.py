"""Front and rear camera of Goal1: a ray caster on MuJoCo's `mj_multiRay`. No OpenGL; the same bytes every time.

The cameras ride on the robot, so in its frame every ray is a constant: which rays end on the robot itself and where the others meet the
floor is known beforehand. What is left per image is a checker pattern, discs on the floor, and rays cast at the few pixels that a
three-dimensional object can cover. P = 2 * 64 * 64 pixels, front image first.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks import goal1_model as g1
from wasp_cli.tasks.base import CAMERA_SIZE, Floats, Pixels

_Image = NDArray[np.float32]

CAMERA_Z = g1.AGENT_Z + 0.15
FRONT_SLOPE = 0.4
"""The front camera looks down by this slope (21.8 degrees), the rear camera is level; both have 90 degrees field of view."""

SKY = (0.012, 0.012, 0.02)
TILE_DARK, TILE_LIGHT = (0.859, 0.843, 0.765), (0.949, 0.914, 0.855)
TILE_SIDE = 0.35
SPHERE_COLOUR, ARROW_COLOUR = (0.7412, 0.0431, 0.1843), (0.0039, 0.1529, 0.3961)
VASE_COLOUR, GOAL_COLOUR, HAZARD_COLOUR = (0.0, 1.0, 1.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
# More opaque than the reference package (0.25): far hazards and goals are a few pixels at 64 x 64 and would vanish from the latent.
GOAL_ALPHA = HAZARD_ALPHA = 0.7


class Scene(NamedTuple):
    """What there is to see in n episodes, world frame."""

    agent_xy: Floats
    """[n, 2]"""
    agent_yaw: Floats
    """[n]"""
    goal_xy: Floats
    """[n, 2]"""
    hazards_xy: Floats
    """[n, K, 2]"""
    vase: Floats
    """[n, 7] position and quaternion."""


class Camera:
    """Renders scenes; owns one MjData per thread and never touches the task's physics."""

    def __init__(self, model: mujoco.MjModel, threads: int = 1) -> None:
        self._model = model
        self._data = [mujoco.MjData(model) for _ in range(threads)]
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="camera") if threads > 1 else None
        self._view = _view(model)
        self._goal_body = int(model.body_mocapid[model.body("goal").id])
        self._goal_radius = float(model.geom_rbound[model.geom("goal").id])
        self._vase_radius = float(model.geom_rbound[model.geom("vase").id])

    def render(self, scene: Scene) -> Pixels:
        """uint8 [n, 6, 64, 64]: front RGB, then rear RGB. A row's bytes depend on its own scene only."""
        rows = len(scene.agent_xy)
        out = np.empty((rows, 6, CAMERA_SIZE, CAMERA_SIZE), np.uint8)

        def work(worker: int) -> None:
            for row in range(worker, rows, len(self._data)):
                out[row] = self._render_row(self._data[worker], scene, row)

        if self._pool is None:
            work(0)
        else:
            list(self._pool.map(work, range(len(self._data))))
        return out

    def _render_row(self, data: mujoco.MjData, scene: Scene, row: int) -> Pixels:
        view = self._view
        yaw, (x, y) = float(scene.agent_yaw[row]), scene.agent_xy[row].tolist()
        cos, sin = math.cos(yaw), math.sin(yaw)

        def to_body(px: float, py: float) -> tuple[float, float]:
            return cos * (px - x) + sin * (py - y), cos * (py - y) - sin * (px - x)

        image = view.floor(x, y, cos, sin)
        view.paint_hazards(image, [to_body(px, py) for px, py in scene.hazards_xy[row].tolist()])
        image += view.still

        # Cast in the robot's frame: the objects move, the rays stay.
        vase = scene.vase[row]
        vase_xyz = np.array([*to_body(float(vase[0]), float(vase[1])), float(vase[2])])
        goal_xyz = np.array([*to_body(*scene.goal_xy[row].tolist()), g1.GOAL_Z])
        data.qpos[:3] = 0.0
        data.qpos[3:6] = vase_xyz
        mujoco.mju_mulQuat(data.qpos[6:10], np.array([math.cos(yaw / 2), 0.0, 0.0, -math.sin(yaw / 2)]), vase[3:7])
        data.mocap_pos[self._goal_body] = goal_xyz
        mujoco.mj_kinematics(self._model, data)
        depth = view.depth
        pixels, distance, shade = view.cast(self._model, data, g1.OPAQUE_GROUP, vase_xyz, self._vase_radius)
        seen = distance < depth[pixels]
        if seen.any():
            depth = depth.copy()
            depth[pixels[seen]] = distance[seen]
            image[:, pixels[seen]] = _colour(VASE_COLOUR) * shade[seen]
        pixels, distance, shade = view.cast(self._model, data, g1.GOAL_GROUP, goal_xyz, self._goal_radius)
        seen = distance < depth[pixels]
        pixels, shade = pixels[seen], shade[seen]
        image[:, pixels] = (1.0 - GOAL_ALPHA) * image[:, pixels] + GOAL_ALPHA * _colour(GOAL_COLOUR) * shade
        image *= 255.0
        image += 0.5
        out: Pixels = image.astype(np.uint8).reshape(3, 2, CAMERA_SIZE, CAMERA_SIZE).swapaxes(0, 1).reshape(6, CAMERA_SIZE, CAMERA_SIZE)
        return out


class _View:
    """The constants of all P rays in the robot's frame, and the painters that use them."""

    def __init__(self, rays: Floats, depth: Floats, still: _Image, on_floor: NDArray[np.bool_]) -> None:
        self.rays = rays
        """float64 [P, 3] unit vectors."""
        self.depth = depth
        """float64 [P] distance to the robot's own body or the floor, infinite in the sky."""
        self.still = still
        """float32 [3, P] colours of what never changes (own body, sky), 0 on the floor."""
        hit = np.where(on_floor, CAMERA_Z / np.maximum(-rays[:, 2], 1e-9), 0.0)
        top = np.where(on_floor, (CAMERA_Z - g1.HAZARD_Z - g1.HAZARD_HALF_HEIGHT) / np.maximum(-rays[:, 2], 1e-9), 0.0)
        self._x, self._y = (hit * rays[:, 0]).astype(np.float32), (hit * rays[:, 1]).astype(np.float32)
        self._top_x, self._top_y = (top * rays[:, 0]).astype(np.float32), (top * rays[:, 1]).astype(np.float32)
        # A pixel's footprint on the floor, along its longer side: squares smaller than that fade into their mean.
        footprint = hit / np.maximum(-rays[:, 2], 1e-9) * (2.0 / CAMERA_SIZE)
        self._sharpness = (TILE_SIDE / np.maximum(footprint, 1e-9)).astype(np.float32)
        self._contrast = np.clip(2.0 - 2.0 * footprint / TILE_SIDE, 0.0, 1.0).astype(np.float32)
        self._light = (on_floor / (1.0 + (hit / 12.0) ** 2)).astype(np.float32)

    def floor(self, x: float, y: float, cos: float, sin: float) -> _Image:
        """The checker floor [3, P] seen from (x, y), unpainted, 0 elsewhere."""
        c, s = np.float32(cos), np.float32(sin)
        mix = self._stripes(c * self._x - s * self._y, x) * self._stripes(s * self._x + c * self._y, y) * self._contrast
        image = np.empty((3, len(mix)), np.float32)
        for channel, (dark, light) in enumerate(zip(TILE_DARK, TILE_LIGHT, strict=True)):
            np.multiply(mix, np.float32((light - dark) / 2.0), out=image[channel])
            image[channel] += np.float32((light + dark) / 2.0)
            image[channel] *= self._light
        return image

    def _stripes(self, place: _Image, offset: float) -> _Image:
        # A square wave of period two tiles, its edges as wide as a pixel. The offset is reduced first, in float64.
        phase = place * np.float32(0.5 / TILE_SIDE) + np.float32((offset * 0.5 / TILE_SIDE + 0.25) % 1.0)
        phase -= np.floor(phase)
        wave: _Image = np.float32(0.25) - np.abs(phase - np.float32(0.5))
        wave *= np.float32(4.0) * self._sharpness
        np.clip(wave, np.float32(-1.0), np.float32(1.0), out=wave)
        return wave

    def paint_hazards(self, image: _Image, centres: list[tuple[float, float]]) -> None:
        """Blend the hazards' discs over the floor. Nothing tells from the picture whether a cost is being paid."""
        inside = np.zeros(len(self._x), np.bool_)
        for hx, hy in centres:
            dx, dy = self._top_x - np.float32(hx), self._top_y - np.float32(hy)
            inside |= dx * dx + dy * dy < np.float32(g1.HAZARD_RADIUS**2)
        pixels = np.flatnonzero(inside & (self._light > 0))
        for channel, colour in enumerate(HAZARD_COLOUR):
            image[channel, pixels] *= np.float32(1.0 - HAZARD_ALPHA)
            image[channel, pixels] += np.float32(HAZARD_ALPHA * colour) * self._light[pixels]

    def cast(
        self, model: mujoco.MjModel, data: mujoco.MjData, group: int, centre: Floats, radius: float
    ) -> tuple[NDArray[np.intp], Floats, _Image]:
        """Cast at one object of bounding radius `radius`: the n pixels that hit it, their distances and their shades."""
        offset = centre - np.array([0.0, 0.0, CAMERA_Z])
        distance = math.sqrt(float(offset @ offset))
        if distance > radius:
            towards = self.rays @ (offset / distance)
            candidates = np.flatnonzero(towards >= math.sqrt(1.0 - (radius / distance) ** 2) - 1e-9)
        else:
            candidates = np.arange(len(self.rays))
        rays = self.rays[candidates]
        hits, normals, _ = _multi_ray(model, data, group, rays)
        found = hits >= 0.0
        normals, rays = normals[found], rays[found]
        return candidates[found], hits[found], _shade(normals, rays)


def _multi_ray(model: mujoco.MjModel, data: mujoco.MjData, group: int, rays: Floats) -> tuple[Floats, Floats, NDArray[np.int32]]:
    """Distances [n] (negative: nothing hit), surface normals [n, 3] and geom ids [n] along rays [n, 3] from the camera."""
    count = len(rays)
    distance, normal, geoms = np.full(count, -1.0), np.zeros(3 * count), np.full(count, -1, np.int32)
    if count:
        groups = np.zeros(6, np.uint8)
        groups[group] = 1
        origin = np.array([0.0, 0.0, CAMERA_Z])
        mujoco.mj_multiRay(model, data, origin, rays.reshape(-1), groups, True, -1, geoms, distance, normal, count, 1e3)
    return distance, normal.reshape(-1, 3), geoms


def _shade(normals: Floats, rays: Floats) -> _Image:
    """Brightness [n] in [0.45, 1]: a light straight above and one at the camera."""
    facing = np.abs((normals * rays).sum(axis=1))
    shade: _Image = (0.45 + 0.3 * np.maximum(normals[:, 2], 0.0) + 0.25 * facing).astype(np.float32)
    return shade


def _colour(rgb: tuple[float, float, float]) -> _Image:
    return np.array(rgb, np.float32)[:, None]


def _camera_rays(forward: Floats) -> Floats:
    """Unit vectors [64 * 64, 3] through the pixel centres of a camera with 90 degrees field of view, top row first."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    at = (np.arange(CAMERA_SIZE) + 0.5) / (CAMERA_SIZE / 2) - 1.0
    rays = forward + at[None, :, None] * right - at[:, None, None] * up
    unit: Floats = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
    return unit


def _view(model: mujoco.MjModel) -> _View:
    """Cast all rays once at the robot itself."""
    rays = np.concatenate([_camera_rays(np.array([1.0, 0.0, -FRONT_SLOPE])), _camera_rays(np.array([-1.0, 0.0, 0.0]))])
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    depth = np.where(rays[:, 2] < -1e-6, CAMERA_Z / np.maximum(-rays[:, 2], 1e-9), np.inf)
    on_floor = np.isfinite(depth)
    still = np.where(on_floor, np.float32(0.0), _colour(SKY))
    distance, normals, geoms = _multi_ray(model, data, g1.AGENT_GROUP, rays)
    nearer = (distance >= 0.0) & (distance < depth)
    for geom, colour in (("agent", SPHERE_COLOUR), ("pointarrow", ARROW_COLOUR)):
        seen = nearer & (geoms == model.geom(geom).id)
        still[:, seen] = _colour(colour) * _shade(normals[seen], rays[seen])
    depth[nearer] = distance[nearer]
    on_floor &= ~nearer
    return _View(rays, depth, still, on_floor)
