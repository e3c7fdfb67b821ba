"""Front and rear camera of every task: a ray caster without OpenGL that gives the same bytes every time.

The floor is a plane, walls and columns stand upright (`panorama`), the robot's own body never changes (`rays`), and only movable
things need rays cast at solids (`solids`, with `mj_multiRay`). A frame uses nothing but additions, multiplications, divisions, square
roots and comparisons in a fixed order, on poses that were rounded to float32: the same scene gives the same bytes on every machine.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from wasp_cli.tasks.base import CAMERA_SIZE, Pixels
from wasp_cli.tasks.camera.backdrop import Backdrop
from wasp_cli.tasks.camera.frame import Frame, column, open_frame, rounded
from wasp_cli.tasks.camera.look import Kind, Look, Scene, Shades
from wasp_cli.tasks.camera.rays import make_view, rectangles
from wasp_cli.tasks.camera.solids import Hits, Near, Solids


class Camera:
    """Renders scenes of one look; never touches the task's physics."""

    def __init__(self, look: Look, threads: int = 1) -> None:
        self._height = look.camera_height
        self._view = make_view(look)
        self._backdrop = Backdrop(look, self._view)
        solid = [kind for kind in look.kinds if kind.column is None and kind.painted is None]
        # Opaque things first: what is behind a translucent one must be there when that is blended in.
        self._kinds = sorted(solid, key=lambda kind: kind.alpha < 1.0)
        self._solids = [{kind.name: Solids(kind) for kind in self._kinds} for _ in range(threads)]
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="camera") if threads > 1 else None

    def render(self, scene: Scene) -> Pixels:
        """uint8 [n, 6, 64, 64]: front RGB, then rear RGB. A row's bytes depend on its own scene only."""
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
        """float32 [n, 2, 64, 64]: distance in m of what is seen (through translucent things), FAR in the sky. For tests and figures."""
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
