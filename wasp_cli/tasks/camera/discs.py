"""Flat discs that are painted onto the floor. m = pixels that see the floor; P = 2 * 64 * 64
pixels, front image first.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import CAMERA_SIZE
from wasp_cli.tasks.camera.appearance import Kind, Shades, Things
from wasp_cli.tasks.camera.frame import Poses, column, put, rounded
from wasp_cli.tasks.camera.spheres import rectangles


class Discs:
    """All discs of one kind in a scene that any camera can see, with the rows of its image that
    may show them.
    """

    def __init__(self, kind: Kind, poses: Poses, things: Things) -> None:
        assert kind.painted is not None
        self._colour, self._alpha = column(kind.colour), np.float32(kind.alpha)
        rows, which = np.nonzero(things.shown)
        place, origin = rounded(things.position[rows, which]), poses.origin[rows]
        drop = origin[:, 2] - place[:, 2]
        above = np.flatnonzero(drop > 0.0)
        rows, place, origin, drop = rows[above], place[above], origin[above], drop[above]
        seen, edges = rectangles(
            poses.axes[rows], place - origin, np.full(len(rows), kind.painted + 1e-4)
        )
        shift = (origin[:, :2] - place[:, :2]) / drop[:, None]
        limit = (kind.painted / drop) ** 2
        self._strips: list[list[tuple[int, int, np.float32, np.float32, np.float32]]] = [
            [] for _ in poses.origin
        ]
        """By row of the scene: first pixel and last plus one, what to add to the rays' x and y,
        and the square of the radius.
        """
        for camera in range(2):
            found = np.flatnonzero(seen[:, camera])
            begin, end = ((camera * CAMERA_SIZE + edges[found, camera, :2]) * CAMERA_SIZE).T
            columns = (rows[found], begin, end, shift[found, 0], shift[found, 1], limit[found])
            for row, first, last, x, y, radius2 in zip(
                *(each.tolist() for each in columns), strict=True
            ):
                self._strips[row].append(
                    (first, last, np.float32(x), np.float32(y), np.float32(radius2))
                )

    def paint(self, colours: Shades, row: int, pixels: NDArray[np.intp], run: Shades) -> None:
        """Blend the discs of a row over the floor's colours [3, m]. Nothing tells from the picture
        whether a cost is being paid.

        Args:
            colours: is changed.
            row: of the scene.
            pixels: [m] that see the floor, ascending.
            run: [2, m] how far their rays go in x and y while they fall by 1 m.
        """
        strips = self._strips[row]
        inside = np.zeros(len(pixels), np.bool_)
        bounds = np.searchsorted(pixels, [strip[:2] for strip in strips]).tolist() if strips else []
        for (begin, end), (_, _, x, y, radius2) in zip(bounds, strips, strict=True):
            if begin < end:
                dx = run[0, begin:end] + x
                dy = run[1, begin:end] + y
                dx *= dx
                dy *= dy
                dx += dy
                inside[begin:end] |= dx < radius2
        found = np.flatnonzero(inside)
        if len(found):
            mixed = np.take(colours, found, axis=1)
            mixed += self._alpha * (self._colour - mixed)
            put(colours, found, mixed)
