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


class Window(NamedTuple):
    """A rectangle of the image of one camera: an index into [2, 64, 64]."""

    camera: int
    rows: slice
    columns: slice


class Box(NamedTuple):
    """Pixels that may show a sphere."""

    at: Window
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


class BodyPoses(NamedTuple):
    """Poses of bodies and of their geoms, as `MjData` has them. M = bodies."""

    mass_position: Floats  # [M, 3]
    mass_rotation: Floats  # [M, 9]
    geom_position: Floats  # [M, G, 3]
    geom_rotation: Floats  # [M, G, 9]


class Placed(NamedTuple):
    """The things of one kind that are in sight, of all rows: of each row the nearest first."""

    start: list[int]  # [n + 1] where each row's begin
    boxes: list[list[Box]]  # [M]
    poses: BodyPoses


class Solids:
    """One kind of thing: which of them the cameras see, and at which pixels."""

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
            reachable = np.flatnonzero(x * x + y * y + z * z < self._reach2)
            rows = rows[reachable]
            which = which[reachable]
            position = position[reachable]
        rotation = rounded(things.rotation[rows, which])
        middle = position + _turned(rotation, self._centres[0]) - poses.origin[rows]
        return Near(rows, position, rotation, middle)

    def place(self, poses: Poses, near: Near, seen: Bools, edges: NDArray[np.intp]) -> Placed:
        """Order what is in sight, of things in the rectangles `seen` [k, 2], `edges` [k, 2, 4]
        that may show them.
        """
        # What either camera sees, by row and distance.
        x, y, z = near.middle.T
        distance = np.sqrt(x * x + y * y + z * z)
        sight = np.flatnonzero(seen[:, 0] | seen[:, 1])
        sight = sight[np.lexsort((distance[sight], near.rows[sight]))]
        rows = near.rows[sight]
        position = near.position[sight]
        rotation = near.rotation[sight]
        in_sight = Near(rows, position, rotation, near.middle[sight])
        boxes = self._boxes(poses, in_sight, seen[sight], edges[sight], distance[sight])
        # Their poses.
        geoms = len(self._geom_position)
        turn = rotation[:, None]
        if self._aligned:
            geom_rotation = np.repeat(rotation, geoms, axis=0)
        else:
            geom_rotation = _product(turn, self._geom_rotation)
        return Placed(
            start=np.searchsorted(rows, np.arange(len(poses.origin) + 1)).tolist(),
            boxes=boxes,
            poses=BodyPoses(
                mass_position=position + _turned(rotation, self._mass_position),
                mass_rotation=_product(rotation, self._mass_rotation).reshape(-1, 9),
                geom_position=position[:, None] + _turned(turn, self._geom_position),
                geom_rotation=geom_rotation.reshape(len(rows), geoms, 9),
            ),
        )

    def _boxes(
        self, poses: Poses, near: Near, seen: Bools, edges: NDArray[np.intp], distance: Floats
    ) -> list[list[Box]]:
        """The boxes of each of k things; `seen` [k, 2], `edges` [k, 2, 4] and `distance` [k]."""
        boxes: list[list[Box]] = [[] for _ in near.rows]
        # So close that the sphere around the whole thing fills the view: take its geoms one by one.
        close = distance < 1.5 * self.radius
        all_edges = edges.tolist()
        all_centres = near.middle.tolist()
        all_nearest = (distance - self.radius).tolist()
        for thing, camera in np.argwhere(seen & ~close[:, None]).tolist():
            box = _box(
                camera,
                all_edges[thing][camera],
                all_centres[thing],
                self.radius,
                all_nearest[thing],
            )
            boxes[thing].append(box)
        for thing in np.flatnonzero(close).tolist():
            row = near.rows[thing]
            centres = (
                near.position[thing]
                + _turned(near.rotation[thing], self._centres[1:])
                - poses.origin[row]
            )
            parts, part_edges = rectangles(poses.axes[row][None], centres, self._radii[1:])
            for part, camera in np.argwhere(parts).tolist():
                box = _box(
                    camera,
                    part_edges[part, camera].tolist(),
                    centres[part].tolist(),
                    float(self._radii[1 + part]),
                    all_nearest[thing],
                )
                boxes[thing].append(box)
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
            for box in placed.boxes[thing]:
                at = box.at
                if box.large:
                    open_ = _may_meet(rays[:, *at], depth[at], turn, box.centre, box.radius)
                else:
                    open_ = depth[at] > box.nearest
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
        """Cast at some things through the pixels of the mask, and empty the mask."""
        size = next(size for size in SLOTS if size >= len(drawn))
        if size not in self._models:
            self._models[size] = _CopyModel(self._kind, size)
        copies = self._models[size]
        copies.place(placed, drawn)
        pixels = np.flatnonzero(self._mask)
        self._mask[:] = False
        towards = frame.rays(pixels).T.astype(np.float64, order="C")
        hit = cast(copies.model, copies.data, frame.origin, towards)
        hit_depth = hit.distance.astype(np.float32)
        seen = np.flatnonzero((hit.distance >= 0.0) & (hit_depth < frame.depth[pixels]))
        return Hits(pixels[seen], hit_depth[seen], shade(hit.normals[seen], towards[seen]))


def _box(camera: int, edges: list[int], centre: list[float], radius: float, nearest: float) -> Box:
    """A box with the edges top, bottom, left and right [4]; the other arguments as of `Box`."""
    top, bottom, left, right = edges
    large = (bottom - top) * (right - left) >= _LARGE and nearest > 0.0
    at = Window(camera, slice(top, bottom), slice(left, right))
    return Box(at, large, centre, radius, nearest)


def _may_meet(
    rays: Shades, depth: Shades, turn: list[list[float]], centre: list[float], radius: float
) -> Bools:
    """Tell [h, w] whether rays [3, h, w] of the robot's frame enter a sphere before `depth` [h,
    w], with slack for what is rounded.
    """
    # The sphere's centre in the robot's frame, and how far along each ray it is.
    local = [axis[0] * centre[0] + axis[1] * centre[1] + axis[2] * centre[2] for axis in turn]
    x = np.float32(local[0])
    y = np.float32(local[1])
    z = np.float32(local[2])
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
        # Views of MuJoCo's own arrays: what is written into them moves the copies.
        self._arrays = BodyPoses(
            mass_position=self.data.xipos[1:],
            mass_rotation=self.data.ximat[1:],
            geom_position=self.data.geom_xpos.reshape(size, geoms, 3),
            geom_rotation=self.data.geom_xmat.reshape(size, geoms, 9),
        )
        self._used = 0  # copies that are shown

    def place(self, placed: Placed, things: list[int]) -> None:
        """Show these things, and no others: `mj_kinematics` without quaternions."""
        count = len(things)
        # A single thing is sliced, which is faster.
        chosen = slice(things[0], things[0] + 1) if count == 1 else things
        for array, poses in zip(self._arrays, placed.poses, strict=True):
            array[:count] = poses[chosen]
        if count < self._used:
            self._arrays.mass_position[count : self._used, 2] = _PARKED
            self._arrays.geom_position[count : self._used, :, 2] = _PARKED
        self._used = count


def _turned(rotation: Floats, vector: Floats) -> Floats:
    """[..., 3] vectors [..., 3] turned by rotations [..., 3, 3]; summed in a fixed order."""
    x = vector[..., 0, None]
    y = vector[..., 1, None]
    z = vector[..., 2, None]
    turned: Floats = rotation[..., 0] * x + rotation[..., 1] * y + rotation[..., 2] * z
    return turned


def _product(first: Floats, second: Floats) -> Floats:
    """[..., 3, 3] matrix products; summed in a fixed order."""
    terms = [first[..., :, k, None] * second[..., None, k, :] for k in range(3)]
    product: Floats = terms[0] + terms[1] + terms[2]
    return product
