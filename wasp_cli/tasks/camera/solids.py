"""Movable things: where the cameras see them, and the rays that are cast at them. n = rows, M =
things in sight, G = geoms of a kind.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import CAMERA_SIZE, Bools, Floats
from wasp_cli.tasks.camera.appearance import Kind, Shades, Things
from wasp_cli.tasks.camera.frame import Frame, Poses, cast, rounded, shade
from wasp_cli.tasks.camera.spheres import bounding_spheres, rectangles

SLOTS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
"""Copies of a thing in the models to choose from: every copy in a model costs time for every
ray.
"""
_MANY = 250  # pixels from which on a thing is cast at alone
_PARKED = -1000.0  # height at which a thing waits that is not drawn
# pixels from which on it pays to ask for every single one whether its ray meets the sphere
_LARGE = 300


class Hits(NamedTuple):
    """The pixels that see a thing of one kind."""

    pixels: NDArray[np.intp]  # [m]
    depth: Shades  # [m]
    shade: Shades  # [m]


class Box(NamedTuple):
    """Pixels that may show a sphere."""

    at: tuple[int, slice, slice]  # camera, rows, columns
    large: bool
    centre: list[float]  # [3] of the sphere, relative to the camera
    radius: float
    nearest: float  # distance in m from which on it may begin


class Near(NamedTuple):
    """The things of one kind within reach of the cameras of their rows: k of them."""

    rows: NDArray[np.intp]  # [k]
    position: Floats  # [k, 3] world
    rotation: Floats  # [k, 3, 3]
    middle: Floats  # [k, 3] of the sphere around each, relative to the camera


class Placed(NamedTuple):
    """The things of one kind that are in sight, of all rows: of each row the nearest first."""

    start: list[int]  # [n + 1] where each row's begin
    boxes: list[list[Box]]  # [M]
    poses: tuple[Floats, Floats, Floats, Floats]
    """[M, 3], [M, 9], [M, G, 3], [M, G, 9]: middles of mass and their axes, then places and
    axes of geoms, as `MjData` has them.
    """


class Solids:
    """One kind of thing."""

    def __init__(self, kind: Kind) -> None:
        self._kind = kind
        model = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody><body>{kind.geoms}</body></worldbody></mujoco>"
        )
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._geom_position = model.geom_pos.copy()
        self._geom_rotation = data.geom_xmat.reshape(-1, 3, 3).copy()
        self._aligned = bool((self._geom_rotation == np.eye(3)).all())
        self._mass_position = model.body_ipos[1].copy()
        self._mass_rotation = data.ximat[1].reshape(3, 3).copy()
        self._centres, self._radii = bounding_spheres(kind)
        self.radius = float(self._radii[0])  # of the sphere around the whole thing
        self._reach2 = np.inf if kind.reach is None else kind.reach**2

    def near(self, poses: Poses, things: Things) -> Near:
        """Find what is within reach."""
        rows, which = np.nonzero(things.shown)
        position = rounded(things.position[rows, which])
        if self._reach2 < np.inf:
            x, y, z = (position - poses.origin[rows]).T
            found = np.flatnonzero(x * x + y * y + z * z < self._reach2)
            rows, which, position = rows[found], which[found], position[found]
        rotation = rounded(things.rotation[rows, which])
        return Near(
            rows,
            position,
            rotation,
            position + _turned(rotation, self._centres[0]) - poses.origin[rows],
        )

    def place(self, poses: Poses, near: Near, seen: Bools, edges: NDArray[np.intp]) -> Placed:
        """Order what is in sight, of things in the rectangles `seen` [k, 2], `edges` [k, 2, 4]
        that may show them.
        """
        rows, position, rotation, middle = near
        x, y, z = middle.T
        distance = np.sqrt(x * x + y * y + z * z)
        sight = np.flatnonzero(seen[:, 0] | seen[:, 1])
        sight = sight[np.lexsort((distance[sight], rows[sight]))]
        rows, position, rotation = rows[sight], position[sight], rotation[sight]
        boxes = self._boxes(
            poses,
            Near(rows, position, rotation, middle[sight]),
            seen[sight],
            edges[sight],
            distance[sight],
        )
        turn = rotation[:, None]
        turned = (
            np.repeat(rotation, len(self._geom_position), axis=0)
            if self._aligned
            else _product(turn, self._geom_rotation)
        )
        return Placed(
            np.searchsorted(rows, np.arange(len(poses.origin) + 1)).tolist(),
            boxes,
            (
                position + _turned(rotation, self._mass_position),
                _product(rotation, self._mass_rotation).reshape(-1, 9),
                position[:, None] + _turned(turn, self._geom_position),
                turned.reshape(len(rows), len(self._geom_position), 9),
            ),
        )

    def _boxes(
        self, poses: Poses, near: Near, seen: Bools, edges: NDArray[np.intp], distance: Floats
    ) -> list[list[Box]]:
        rows, position, rotation, middle = near
        boxes: list[list[Box]] = [[] for _ in rows]
        # So close that the sphere around the whole thing fills the view: take its geoms one by one.
        close = distance < 1.5 * self.radius
        columns = (seen & ~close[:, None], edges, middle, distance - self.radius)
        for thing, (whole, edge, centre, nearest) in enumerate(
            zip(*(each.tolist() for each in columns), strict=True)
        ):
            boxes[thing] += [
                _box(camera, edge[camera], centre, self.radius, nearest)
                for camera in range(2)
                if whole[camera]
            ]
        for thing in np.flatnonzero(close).tolist():
            centres = (
                position[thing]
                + _turned(rotation[thing], self._centres[1:])
                - poses.origin[rows[thing]]
            )
            parts, part_edges = rectangles(poses.axes[rows[thing]][None], centres, self._radii[1:])
            for part, camera in np.argwhere(parts).tolist():
                where = (
                    part_edges[part, camera].tolist(),
                    centres[part].tolist(),
                    float(self._radii[1 + part]),
                )
                boxes[thing].append(_box(camera, *where, float(distance[thing]) - self.radius))
        return boxes

    def caster(self) -> Caster:
        """Return what casts rays at copies of it; not to be shared by threads."""
        return Caster(self._kind)


class Caster:
    """Models with copies of one thing, which are moved to where the things are."""

    def __init__(self, kind: Kind) -> None:
        self._kind = kind
        self._models: dict[int, _CopyModel] = {}
        self._mask = np.zeros((2, CAMERA_SIZE, CAMERA_SIZE), np.bool_)

    def see(self, placed: Placed, row: int, frame: Frame) -> Iterator[Hits]:
        """Cast at the things of one row.

        A pixel counts when the thing is nearer than the frame's depth; what was yielded may be
        entered into that before the next is asked for.
        """
        mask = self._mask
        depth = frame.depth.reshape(mask.shape)
        rays = frame.body_rays.reshape(3, *mask.shape)
        turn = frame.turn.astype(np.float64).T.tolist()
        drawn: list[int] = []
        for thing in range(placed.start[row], placed.start[row + 1]):
            pixels = 0
            for at, large, centre, radius, nearest in placed.boxes[thing]:
                open_ = (
                    _may_meet(rays[:, *at], depth[at], turn, centre, radius)
                    if large
                    else depth[at] > nearest
                )
                count = int(np.count_nonzero(open_))
                if count:
                    pixels += count
                    mask[at] |= open_
            if pixels:
                drawn.append(thing)
            # Near things one by one: the next ones are spared the pixels that they hide.
            if drawn and (pixels > _MANY or len(drawn) == SLOTS[-1]):
                yield self._cast(frame, placed, drawn)
                drawn.clear()
        if drawn:
            yield self._cast(frame, placed, drawn)

    def _cast(self, frame: Frame, placed: Placed, drawn: list[int]) -> Hits:
        size = next(size for size in SLOTS if size >= len(drawn))
        if size not in self._models:
            self._models[size] = _CopyModel(self._kind, size)
        copies = self._models[size]
        copies.place(placed, drawn)
        pixels = np.flatnonzero(self._mask)
        self._mask[:] = False
        towards = frame.rays(pixels).T.astype(np.float64, order="C")
        hits, normals, _ = cast(copies.model, copies.data, frame.origin, towards)
        hit_depth = hits.astype(np.float32)
        seen = np.flatnonzero((hits >= 0.0) & (hit_depth < frame.depth[pixels]))
        return Hits(pixels[seen], hit_depth[seen], shade(normals[seen], towards[seen]))


def _box(camera: int, edges: list[int], centre: list[float], radius: float, nearest: float) -> Box:
    top, bottom, left, right = edges
    large = (bottom - top) * (right - left) >= _LARGE and nearest > 0.0
    return Box((camera, slice(top, bottom), slice(left, right)), large, centre, radius, nearest)


def _may_meet(
    rays: Shades, depth: Shades, turn: list[list[float]], centre: list[float], radius: float
) -> Bools:
    """Tell [h, w] whether rays [3, h, w] of the robot's frame enter a sphere before `depth` [h,
    w], with slack for what is rounded.
    """
    x, y, z = (
        np.float32(axis[0] * centre[0] + axis[1] * centre[1] + axis[2] * centre[2]) for axis in turn
    )
    along: Shades = rays[0] * x
    along += rays[1] * y
    along += rays[2] * z
    # The square of half the chord. A ray that meets the sphere behind `depth` alone has the middle
    # of its chord there.
    chord = along * along
    chord -= np.float32(
        (centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2) * (1.0 - 4e-6) - (radius + 1e-4) ** 2
    )
    behind = np.maximum(along - depth, np.float32(0.0))
    behind *= behind
    met: Bools = behind < chord
    met &= along > 0
    return met


class _CopyModel:
    """A model of `size` copies of a thing."""

    def __init__(self, kind: Kind, size: int) -> None:
        body = f'<body mocap="true" pos="0 0 {_PARKED}">{kind.geoms}</body>'
        self.model = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody>{body * size}</worldbody></mujoco>"
        )
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        geoms = self.model.ngeom // size
        data = self.data
        self._arrays = (
            data.xipos[1:],
            data.ximat[1:],
            data.geom_xpos.reshape(size, geoms, 3),
            data.geom_xmat.reshape(size, geoms, 9),
        )
        self._used = 0

    def place(self, placed: Placed, things: list[int]) -> None:
        """Show these things, and no others: `mj_kinematics` without quaternions."""
        count = len(things)
        for array, poses in zip(self._arrays, placed.poses, strict=True):
            array[:count] = poses[things[0] : things[0] + 1] if count == 1 else poses[things]
        if count < self._used:
            self._arrays[0][count : self._used, 2] = _PARKED
            self._arrays[2][count : self._used, :, 2] = _PARKED
        self._used = count


def _turned(rotation: Floats, vector: Floats) -> Floats:
    """[..., 3] vectors [..., 3] turned by rotations [..., 3, 3]; summed in a fixed order."""
    x, y, z = vector[..., 0, None], vector[..., 1, None], vector[..., 2, None]
    turned: Floats = rotation[..., 0] * x + rotation[..., 1] * y + rotation[..., 2] * z
    return turned


def _product(first: Floats, second: Floats) -> Floats:
    """[..., 3, 3] matrix products; summed in a fixed order."""
    terms = (first[..., :, k, None] * second[..., None, k, :] for k in range(3))
    product: Floats = next(terms) + next(terms) + next(terms)
    return product
