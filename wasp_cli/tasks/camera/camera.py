"""Front and rear camera of every task: a ray caster without OpenGL that gives the same bytes every
time.

The floor is a plane, walls and columns stand upright (`panorama`), the robot's own body never
changes (`frame`), and only movable things need rays cast at solids (with `mj_multiRay`). A frame
uses nothing but additions, multiplications, divisions, square roots and comparisons in a fixed
order, on poses that were rounded to float32: the same scene gives the same bytes on every machine.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from wasp_cli.tasks.base import CAMERA_SIZE, Pixels
from wasp_cli.tasks.camera.appearance import Appearance, Kind, Scene, Shades
from wasp_cli.tasks.camera.backdrop import Ahead, Backdrop
from wasp_cli.tasks.camera.frame import Frame, Poses, camera_poses, column, make_view, open_frame
from wasp_cli.tasks.camera.solids import Caster, Hits, Placed, Solids
from wasp_cli.tasks.camera.spheres import rectangles


class Plan(NamedTuple):
    """What is computed for all rows of a scene at once, before any pixel is."""

    poses: Poses
    ahead: Ahead
    placed: list[Placed]  # of each kind that rays are cast at


class Camera:
    """Renders scenes of one appearance; never touches the task's physics."""

    def __init__(self, appearance: Appearance, threads: int = 1) -> None:
        self._appearance = appearance
        self._threads = threads
        self._height = appearance.camera_height
        self._view = make_view(appearance)
        self._backdrop = Backdrop(appearance, self._view)
        solid = [kind for kind in appearance.kinds if kind.column is None and kind.painted is None]
        # Opaque things first: what is behind a translucent one must be there when that is blended
        # in.
        self._kinds = sorted(solid, key=_is_translucent)
        self._solids = [Solids(kind) for kind in self._kinds]
        # Each thread has casters of its own, one for each kind.
        self._casters: list[list[Caster]] = []
        for _ in range(threads):
            self._casters.append([solids.caster() for solids in self._solids])
        self._pool: ThreadPoolExecutor | None = None
        if threads > 1:
            self._pool = ThreadPoolExecutor(threads, thread_name_prefix="camera")

    def __reduce__(self) -> tuple[type[Camera], tuple[Appearance, int]]:
        # Threads cannot be copied, and no picture depends on an earlier one.
        return Camera, (self._appearance, self._threads)

    def render(self, scene: Scene) -> Pixels:
        """Draw uint8 [n, 6, 64, 64]: front RGB, then rear RGB. A row's bytes depend on its own
        scene only.
        """
        rows = len(scene.position)
        plan = self._plan(scene)
        out = np.empty((rows, 6, CAMERA_SIZE, CAMERA_SIZE), np.uint8)
        # Cameras first, as frames have them.
        images = out.reshape(rows, 2, 3, -1).transpose(0, 2, 1, 3)

        def work(worker: int) -> None:
            """Draw every row whose number is `worker`, modulo the number of threads."""
            for row in range(worker, rows, len(self._casters)):
                image = self._draw(self._casters[worker], plan, row).image
                image *= np.float32(255.0)
                image += np.float32(0.5)
                np.copyto(images[row], image.reshape(3, 2, -1), casting="unsafe")

        if self._pool is None:
            work(0)
        else:
            list(self._pool.map(work, range(len(self._casters))))
        return out

    def depth(self, scene: Scene) -> Shades:
        """Measure distances in m float32 [n, 2, 64, 64] of what is seen (through translucent
        things), FAR in the sky. For tests.
        """
        plan = self._plan(scene)
        rows = [self._draw(self._casters[0], plan, row).depth for row in range(len(scene.position))]
        return np.stack(rows).reshape(-1, 2, CAMERA_SIZE, CAMERA_SIZE)

    def _plan(self, scene: Scene) -> Plan:
        poses = camera_poses(self._view, self._height, scene)
        near = [
            solids.near(poses, scene.things[kind.name])
            for kind, solids in zip(self._kinds, self._solids, strict=True)
        ]
        placed: list[Placed] = []
        if near:
            # The pixels that may show the things, of all kinds in one call.
            counts = [len(each.rows) for each in near]
            radii = np.repeat([solids.radius for solids in self._solids], counts)
            rows = np.concatenate([each.rows for each in near])
            middles = np.concatenate([each.middle for each in near])
            seen, edges = rectangles(poses.axes[rows], middles, radii)
            start = 0
            for solids, each in zip(self._solids, near, strict=True):
                part = slice(start, start + len(each.rows))
                placed.append(solids.place(poses, each, seen[part], edges[part]))
                start = part.stop
        return Plan(poses, self._backdrop.look_ahead(poses, scene), placed)

    def _draw(self, casters: list[Caster], plan: Plan, row: int) -> Frame:
        frame = open_frame(self._view, plan.poses, row)
        self._backdrop.draw(frame, plan.ahead, row)
        for kind, caster, placed in zip(self._kinds, casters, plan.placed, strict=True):
            for hits in caster.see(placed, row, frame):
                _enter(frame, hits, kind)
        return frame


def _is_translucent(kind: Kind) -> bool:
    return kind.alpha < 1.0


def _enter(frame: Frame, hits: Hits, kind: Kind) -> None:
    """Draw what rays have hit: opaque things hide what is behind, others are blended over it."""
    colours = column(kind.colour) * hits.shade
    if kind.alpha < 1.0:
        colours *= np.float32(kind.alpha)
        colours += np.float32(1.0 - kind.alpha) * np.take(frame.image, hits.pixels, axis=1)
    else:
        frame.depth[hits.pixels] = hits.depth
    frame.put(hits.pixels, colours)
