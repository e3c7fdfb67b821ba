"""Flat discs that are painted onto the floor. m = pixels that see the floor; P = 2 * 64 * 64
pixels, front image first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import CAMERA_SIZE
from wasp_cli.tasks.camera.appearance import Kind, Shades, Things
from wasp_cli.tasks.camera.frame import Poses, column, put, rounded
from wasp_cli.tasks.camera.spheres import rectangles


class _Strip(NamedTuple):
    """The rows of an image that may show a disc, and where the disc is."""

    first: int  # pixel
    end: int  # the last pixel plus one
    x: np.float32  # what to add to how far a ray goes while it falls by 1 m: the distance ...
    y: np.float32  # ... from the disc's centre, in units of the camera's height above it
    radius2: np.float32  # square of the disc's radius in this unit


class Discs:
    """All discs of one kind in a scene that any camera can see, with the rows of its image that
    may show them.
    """

    def __init__(self, kind: Kind, poses: Poses, things: Things) -> None:
        assert kind.painted is not None
        self._colour = column(kind.colour)
        self._alpha = np.float32(kind.alpha)
        # Discs below their camera.
        rows, which = np.nonzero(things.shown)
        place = rounded(things.position[rows, which])
        origin = poses.origin[rows]
        drop = origin[:, 2] - place[:, 2]
        above = np.flatnonzero(drop > 0.0)
        rows = rows[above]
        place = place[above]
        origin = origin[above]
        drop = drop[above]
        # Where the cameras may see them.
        seen, edges = rectangles(
            poses.axes[rows], place - origin, np.full(len(rows), kind.painted + 1e-4)
        )
        shift = (origin[:, :2] - place[:, :2]) / drop[:, None]
        limit = (kind.painted / drop) ** 2
        self._strips: list[list[_Strip]] = [[] for _ in poses.origin]  # by row of the scene
        for camera in range(2):
            visible = np.flatnonzero(seen[:, camera])
            bounds = (camera * CAMERA_SIZE + edges[visible, camera, :2]) * CAMERA_SIZE
            for disc, (first, end) in zip(visible.tolist(), bounds.tolist(), strict=True):
                strip = _Strip(
                    first=first,
                    end=end,
                    x=np.float32(shift[disc, 0]),
                    y=np.float32(shift[disc, 1]),
                    radius2=np.float32(limit[disc]),
                )
                self._strips[int(rows[disc])].append(strip)

    def paint(self, colours: Shades, row: int, pixels: NDArray[np.intp], run: Shades) -> None:
        """Blend the discs of a row over the floor's colours [3, m]. The picture is the same whether
        or not a cost is being paid.

        Args:
            colours: changed in place.
            row: of the scene.
            pixels: [m] that see the floor, ascending.
            run: [2, m] how far their rays go in x and y while they fall by 1 m.
        """
        strips = self._strips[row]
        if not strips:
            return
        inside = np.zeros(len(pixels), np.bool_)
        bounds = np.searchsorted(pixels, [(strip.first, strip.end) for strip in strips])
        for (begin, end), strip in zip(bounds.tolist(), strips, strict=True):
            if begin < end:
                dx = run[0, begin:end] + strip.x
                dy = run[1, begin:end] + strip.y
                dx *= dx
                dy *= dy
                dx += dy
                inside[begin:end] |= dx < strip.radius2
        covered = np.flatnonzero(inside)
        if len(covered):
            mixed = np.take(colours, covered, axis=1)
            mixed += self._alpha * (self._colour - mixed)
            put(colours, covered, mixed)
