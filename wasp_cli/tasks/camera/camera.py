"""Front and rear camera of every task: a ray caster without OpenGL that gives the same bytes every time.

The floor is a plane, walls and columns stand upright (`panorama`), the robot's own body never changes (`frame`), and only movable
things need rays cast at solids (with `mj_multiRay`). A frame uses nothing but additions, multiplications, divisions, square
roots and comparisons in a fixed order, on poses that were rounded to float32: the same scene gives the same bytes on every machine.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import CAMERA_SIZE, Bools, Floats, Pixels
from wasp_cli.tasks.camera.appearance import Appearance, Kind, Scene, Shades
from wasp_cli.tasks.camera.backdrop import Backdrop
from wasp_cli.tasks.camera.frame import Frame, cast, column, make_view, open_frame, rectangles, rounded, shade

SLOTS = (1, 3, 8, 24)
"""Copies of a thing in the models to choose from: every copy in a model costs time for every ray."""
_MANY = 250
"""Pixels from which on a thing is cast at alone."""
_PARKED = -1000.0
"""Height at which a thing waits that is not drawn."""


class Hits(NamedTuple):
    """The pixels that see a thing of one kind."""

    pixels: NDArray[np.intp]
    """[m]"""
    depth: Shades
    """[m]"""
    shade: Shades
    """[m]"""


class Near(NamedTuple):
    """Things of one kind that are not out of reach: k of them."""

    position: Floats
    """[k, 3]"""
    rotation: Floats
    """[k, 3, 3]"""
    centres: Floats
    """[k, 1 + G, 3] middles of their bounding spheres, relative to the camera: the whole thing's, then those of its G geoms."""


class Solids:
    """One kind of thing, in copies that are moved to where the things are. Not to be shared by threads."""

    def __init__(self, kind: Kind) -> None:
        self._models = [_CopyModel(kind, size) for size in SLOTS]
        self._centres, self._radii = bounding_spheres(kind)
        self._reach2 = np.inf if kind.reach is None else kind.reach**2
        self.radius = float(self._radii[0])
        """Of the sphere around the whole thing."""

    def near(self, origin: Floats, position: Floats, rotation: Floats) -> Near:
        """Return the k within reach of the camera at `origin` [3], of things at `position` [K, 3] in m with `rotation` [K, 3, 3]."""
        x, y, z = (position - origin).T
        found = np.flatnonzero(x * x + y * y + z * z < self._reach2)
        position, rotation = position[found], rotation[found]
        return Near(position, rotation, position[:, None] + _turned(rotation[:, None], self._centres) - origin)

    def see(self, near: Near, seen: Bools, edges: NDArray[np.intp], frame: Frame) -> Iterator[Hits]:
        """Cast at things, in the rectangles `seen` [2, k], `edges` [2, k, 4] that may show them.

        A pixel counts when the thing is nearer than the frame's depth; what was yielded may be entered into that before the next is
        asked for.
        """
        position, rotation, centres = near
        distance = np.sqrt(centres[:, 0, 0] ** 2 + centres[:, 0, 1] ** 2 + centres[:, 0, 2] ** 2)
        radius = self.radius
        mask = np.zeros((2, CAMERA_SIZE, CAMERA_SIZE), np.bool_)
        depth = frame.depth.reshape(mask.shape)
        drawn: list[int] = []
        in_sight = np.flatnonzero(seen[0] | seen[1])
        for thing in in_sight[np.argsort(distance[in_sight], kind="stable")].tolist():
            nearest, pixels = distance[thing] - radius, 0
            boxes = [(camera, *edges[camera, thing].tolist()) for camera in range(2) if seen[camera, thing]]
            if distance[thing] < 1.5 * radius:
                # So close that the sphere around the whole thing fills the view: take its geoms one by one.
                close, parts = rectangles(frame.axes, centres[thing, 1:], self._radii[1:])
                boxes = [(camera, *parts[camera, geom].tolist()) for camera, geom in zip(*np.nonzero(close), strict=True)]
            for camera, top, bottom, left, right in boxes:
                open_ = depth[camera, top:bottom, left:right] > nearest
                pixels += int(np.count_nonzero(open_))
                mask[camera, top:bottom, left:right] |= open_
            if pixels:
                drawn.append(thing)
            # Near things one by one: the next ones are spared the pixels that they hide.
            if drawn and (pixels > _MANY or len(drawn) == SLOTS[-1]):
                yield self._cast(frame, mask, position[drawn], rotation[drawn])
                drawn.clear()
                mask[:] = False
        if drawn:
            yield self._cast(frame, mask, position[drawn], rotation[drawn])

    def _cast(self, frame: Frame, mask: Bools, position: Floats, rotation: Floats) -> Hits:
        copies = next(copies for copies in self._models if copies.size >= len(position))
        copies.place(position, rotation)
        pixels = np.flatnonzero(mask)
        towards = np.take(frame.rays, pixels, axis=1).T.astype(np.float64, order="C")
        hits, normals, _ = cast(copies.model, copies.data, frame.origin, towards)
        hit_depth = hits.astype(np.float32)
        seen = np.flatnonzero((hits >= 0.0) & (hit_depth < frame.depth[pixels]))
        return Hits(pixels[seen], hit_depth[seen], shade(normals[seen], towards[seen]))


class _CopyModel:
    """A model of `size` copies of a thing."""

    def __init__(self, kind: Kind, size: int) -> None:
        body = f'<body mocap="true" pos="0 0 {_PARKED}">{kind.geoms}</body>'
        self.size = size
        self.model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body * size}</worldbody></mujoco>")
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        geoms = self.model.ngeom // size
        self._local_position = self.model.geom_pos[:geoms].copy()
        self._local_rotation = self.data.geom_xmat[:geoms].reshape(-1, 3, 3).copy()
        self._aligned = bool((self._local_rotation == np.eye(3)).all())
        self._local_centre = self.model.body_ipos[1].copy()
        self._local_axes = self.data.ximat[1].reshape(3, 3).copy()
        self._used = 0

    def place(self, position: Floats, rotation: Floats) -> None:
        """Place things at `position` [k, 3] in m with `rotation` [k, 3, 3], and no others: `mj_kinematics` without quaternions."""
        data, count, geoms = self.data, len(position), len(self._local_position)
        data.xipos[1 : count + 1] = position + _turned(rotation, self._local_centre)
        data.ximat[1 : count + 1] = _product(rotation, self._local_axes).reshape(-1, 9)
        turn = rotation[:, None]
        data.geom_xpos[: count * geoms] = (position[:, None] + _turned(turn, self._local_position)).reshape(-1, 3)
        turned = np.repeat(rotation, geoms, axis=0) if self._aligned else _product(turn, self._local_rotation)
        data.geom_xmat[: count * geoms] = turned.reshape(-1, 9)
        if count < self._used:
            data.xipos[count + 1 : self._used + 1, 2] = _PARKED
            data.geom_xpos[count * geoms : self._used * geoms, 2] = _PARKED
        self._used = count


def bounding_spheres(kind: Kind) -> tuple[Floats, Floats]:
    """Return centres [1 + G, 3] in the kind's body frame and radii [1 + G] in m: of the whole thing, then of each of its G geoms."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{kind.geoms}</worldbody></mujoco>")
    centres, radii = model.geom_pos, model.geom_rbound
    middle = ((centres - radii[:, None]).min(axis=0) + (centres + radii[:, None]).max(axis=0)) / 2.0
    whole = (np.sqrt(((centres - middle) ** 2).sum(axis=1)) + radii).max()
    return np.concatenate([middle[None], centres]), np.concatenate([[whole], radii]) + 1e-6


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


class Camera:
    """Renders scenes of one appearance; never touches the task's physics."""

    def __init__(self, appearance: Appearance, threads: int = 1) -> None:
        self._appearance, self._threads = appearance, threads
        self._height = appearance.camera_height
        self._view = make_view(appearance)
        self._backdrop = Backdrop(appearance, self._view)
        solid = [kind for kind in appearance.kinds if kind.column is None and kind.painted is None]
        # Opaque things first: what is behind a translucent one must be there when that is blended in.
        self._kinds = sorted(solid, key=lambda kind: kind.alpha < 1.0)
        self._solids = [{kind.name: Solids(kind) for kind in self._kinds} for _ in range(threads)]
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="camera") if threads > 1 else None

    def __reduce__(self) -> tuple[type[Camera], tuple[Appearance, int]]:
        # Threads cannot be copied, and no picture depends on an earlier one.
        return Camera, (self._appearance, self._threads)

    def render(self, scene: Scene) -> Pixels:
        """Draw uint8 [n, 6, 64, 64]: front RGB, then rear RGB. A row's bytes depend on its own scene only."""
        rows = len(scene.position)
        out = np.empty((rows, 6, CAMERA_SIZE, CAMERA_SIZE), np.uint8)

        def work(worker: int) -> None:
            for row in range(worker, rows, len(self._solids)):
                image = self._draw(self._solids[worker], scene, row).image
                image *= np.float32(255.0)
                image += np.float32(0.5)
                pixels = image.astype(np.uint8).reshape(3, 2, CAMERA_SIZE, CAMERA_SIZE)
                out[row, :3], out[row, 3:] = pixels[:, 0], pixels[:, 1]

        if self._pool is None:
            work(0)
        else:
            list(self._pool.map(work, range(len(self._solids))))
        return out

    def depth(self, scene: Scene) -> Shades:
        """Measure distances in m float32 [n, 2, 64, 64] of what is seen (through translucent things), FAR in the sky. For tests."""
        rows = [self._draw(self._solids[0], scene, row).depth for row in range(len(scene.position))]
        return np.stack(rows).reshape(-1, 2, CAMERA_SIZE, CAMERA_SIZE)

    def _draw(self, solids: dict[str, Solids], scene: Scene, row: int) -> Frame:
        frame = open_frame(self._view, self._height, scene, row)
        self._backdrop.draw(frame, scene, row)
        found: list[tuple[Kind, Near]] = []
        for kind in self._kinds:
            things = scene.things[kind.name]
            shown = np.flatnonzero(things.shown[row])
            if len(shown):
                near = solids[kind.name].near(frame.origin, rounded(things.position[row, shown]), rounded(things.rotation[row, shown]))
                found.append((kind, near))
        if found:
            centres = np.concatenate([near.centres[:, 0] for _, near in found])
            radii = np.concatenate([np.full(len(near.centres), solids[kind.name].radius) for kind, near in found])
            seen, edges = rectangles(frame.axes, centres, radii)
            start = 0
            for kind, near in found:
                part = slice(start, start + len(near.centres))
                for hits in solids[kind.name].see(near, seen[:, part], edges[:, part], frame):
                    _enter(frame, hits, kind)
                start = part.stop
        return frame


def _enter(frame: Frame, hits: Hits, kind: Kind) -> None:
    colours = column(kind.colour) * hits.shade
    if kind.alpha < 1.0:
        colours *= np.float32(kind.alpha)
        colours += np.float32(1.0 - kind.alpha) * np.take(frame.image, hits.pixels, axis=1)
    else:
        frame.depth[hits.pixels] = hits.depth
    frame.put(hits.pixels, colours)
