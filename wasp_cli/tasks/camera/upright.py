"""Walls, landmarks and things that are drawn as columns, as the viewers of all rows of a scene
have them around them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.camera.appearance import Appearance, Scene, Shades
from wasp_cli.tasks.camera.frame import Poses, column
from wasp_cli.tasks.camera.panorama import (
    Panorama,
    Views,
    column_sides,
    draw_panoramas,
    join,
    make_columns,
    wall_sides,
)

_BLOCK = 8  # viewers at once: more save little time, and their numbers leave the processor's cache


class Upright:
    """What stands upright in one appearance."""

    def __init__(self, appearance: Appearance) -> None:
        self._walls, self._wall_layers = wall_sides(appearance.walls, appearance.haze)
        self._marks = appearance.landmarks
        self._columns = [kind for kind in appearance.kinds if kind.column is not None]
        self._horizon = column(appearance.horizon)
        self._anything = bool(appearance.walls or appearance.landmarks or self._columns)

    def panoramas(self, poses: Poses, scene: Scene) -> list[Panorama] | None:
        """Return what stands around each row; None: nothing ever does."""
        if not self._anything:
            return None
        rows = len(poses.origin)
        panoramas: list[Panorama] = []
        for begin in range(0, rows, _BLOCK):
            origin = poses.origin[begin : begin + _BLOCK, :2].astype(np.float32).T
            panoramas += self._block(origin, scene, begin)
        return panoramas

    def _block(self, origin: Shades, scene: Scene, begin: int) -> list[Panorama]:
        """Of the viewers at `origin` [2, n], whose first one is the row `begin` of the scene."""
        count = origin.shape[1]
        marks = self._marks

        # Columns, each for one viewer: landmarks, and things of some kinds. The layers: the walls'
        # own, the landmarks', and one for each kind.
        layers = self._wall_layers
        places = [mark.xy for mark in marks]
        shapes = [(mark.radius, mark.top) for mark in marks]
        colours = [mark.colour for mark in marks]
        viewers = [np.repeat(np.arange(count), len(marks))]
        columns = [make_columns(places * count, shapes * count, colours * count, layers)]
        for kind in self._columns:
            assert kind.column is not None
            layers += 1
            things = scene.things[kind.name]
            rows, which = np.nonzero(things.shown[begin : begin + count])
            viewers.append(rows)
            columns.append(
                make_columns(
                    things.position[begin + rows, which, :2],
                    [kind.column] * len(rows),
                    [kind.colour] * len(rows),
                    layers,
                )
            )
        viewer = np.concatenate(viewers)
        boards = column_sides(join(columns), *origin[:, viewer])

        # The sides that each viewer has around it: all walls, and the boards of its columns.
        walls = self._walls
        sides = join([walls, boards])
        wall_count = walls.start.shape[1]
        wall_side = np.tile(np.arange(wall_count), count)
        board_side = wall_count + np.arange(len(viewer))
        views = Views(
            start=_seen_from(origin, walls.start, boards.start, viewer),
            end=_seen_from(origin, walls.end, boards.end, viewer),
            viewer=np.concatenate([np.repeat(np.arange(count), wall_count), viewer]),
            side=np.concatenate([wall_side, board_side]),
        )
        return draw_panoramas(views, count, sides, layers + 1, self._horizon)


def _seen_from(origin: Shades, wall: Shades, board: Shades, viewer: NDArray[np.intp]) -> Shades:
    """Points of walls [2, S] relative to each of the viewers at `origin` [2, n], then points of
    boards [2, K] relative to their own `viewer` [K] -> [2, n * S + K].
    """
    of_walls = (wall[:, None] - origin[:, :, None]).reshape(2, -1)
    return np.concatenate([of_walls, board - origin[:, viewer]], axis=1)
