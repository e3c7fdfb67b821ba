"""Walls, landmarks and things that are drawn as columns, as the viewers of all rows of a scene
have them around them.
"""

from __future__ import annotations

import numpy as np

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
        found: list[Panorama] = []
        for begin in range(0, rows, _BLOCK):
            found += self._block(
                poses.origin[begin : begin + _BLOCK, :2].astype(np.float32).T, scene, begin
            )
        return found

    def _block(self, origin: Shades, scene: Scene, begin: int) -> list[Panorama]:
        """Of the viewers at `origin` [2, n], whose first one is the row `begin` of the scene."""
        count, marks, layers = origin.shape[1], self._marks, self._wall_layers
        viewers = [np.repeat(np.arange(count), len(marks))]
        shapes, colours = (
            [(mark.radius, mark.top) for mark in marks],
            [mark.colour for mark in marks],
        )
        # The layers: the walls' own, the landmarks', and one for each kind.
        columns = [
            make_columns(
                [mark.xy for mark in marks] * count, shapes * count, colours * count, layers
            )
        ]
        for kind in self._columns:
            assert kind.column is not None
            layers += 1
            things = scene.things[kind.name]
            rows, which = np.nonzero(things.shown[begin : begin + count])
            viewers.append(rows)
            places = things.position[begin + rows, which, :2]
            columns.append(
                make_columns(places, [kind.column] * len(rows), [kind.colour] * len(rows), layers)
            )
        viewer = np.concatenate(viewers)
        boards, walls = column_sides(join(columns), *origin[:, viewer]), self._walls
        sides = join([walls, boards])
        wall_count, at = walls.start.shape[1], origin[:, :, None]
        start, end = (
            np.concatenate([(wall[:, None] - at).reshape(2, -1), board - origin[:, viewer]], axis=1)
            for wall, board in ((walls.start, boards.start), (walls.end, boards.end))
        )
        views = Views(
            start,
            end,
            np.concatenate([np.repeat(np.arange(count), wall_count), viewer]),
            np.concatenate(
                [np.tile(np.arange(wall_count), count), wall_count + np.arange(len(viewer))]
            ),
        )
        return draw_panoramas(views, count, sides, layers + 1, self._horizon)
