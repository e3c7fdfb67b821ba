"""Everything that needs no ray cast at it: sky, floor with the discs on it, walls, columns, and the robot's own body.

m = pixels that see the floor, or a wall.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import CAMERA_SIZE, Floats
from wasp_cli.tasks.camera.appearance import Appearance, Kind, Scene, Shades, Things
from wasp_cli.tasks.camera.frame import FAR, Frame, View, column, put, rounded
from wasp_cli.tasks.camera.panorama import DIRECTIONS, Columns, column_sides, directions, draw_panorama, join, make_columns, wall_sides

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


class _Ground(NamedTuple):
    """The pixels that see the floor."""

    pixels: NDArray[np.intp]
    """[m]"""
    depth: Shades
    """[m] in m."""
    fall: Shades
    """[m] length of the ray on which it falls by 1 m."""
    run_x: Shades
    run_y: Shades
    """[m] how far it goes in x and y meanwhile."""


class Backdrop:
    """Draws it for one appearance and the view of its robot."""

    def __init__(self, appearance: Appearance, view: View) -> None:
        self._appearance, self._view = appearance, view
        self._walls, self._wall_layers = wall_sides(appearance.walls, appearance.haze)
        marks = appearance.landmarks
        shapes, colours = [(mark.radius, mark.top) for mark in marks], [mark.colour for mark in marks]
        self._landmarks = make_columns([mark.xy for mark in marks], shapes, colours, self._wall_layers)
        self._columns = [kind for kind in appearance.kinds if kind.column is not None]
        self._painted = [kind for kind in appearance.kinds if kind.painted is not None]
        self._anything_upright = bool(appearance.walls or appearance.landmarks or self._columns)

    def draw(self, frame: Frame, scene: Scene, row: int) -> None:
        """Fill every pixel of a frame with what is behind the things of one row of a scene, in image and depth (m)."""
        appearance, rays, depth = self._appearance, frame.rays, frame.depth
        # A ray meets the floor at `height * fall`; above the horizon that is so far away that it never counts.
        fall = _ONE / np.maximum(-rays[2], np.float32(1e-6))
        floor_depth = np.float32(frame.origin[2]) * fall
        np.copyto(depth, floor_depth, where=floor_depth < depth)
        if self._anything_upright:
            frame.put(*self._upright(frame, scene, row))
        pixels = np.flatnonzero(depth == floor_depth)
        if len(pixels):
            fall = fall[pixels]
            ground = _Ground(pixels, floor_depth[pixels], fall, rays[0][pixels] * fall, rays[1][pixels] * fall)
            frame.put(pixels, self._floor(ground, frame.origin, scene, row))
        sky = np.flatnonzero(depth >= np.float32(FAR))
        horizon = column(appearance.horizon)
        frame.put(sky, horizon + (column(appearance.zenith) - horizon) * np.clip(rays[2][sky] * np.float32(2.0), _ZERO, _ONE))
        frame.put(self._view.own, self._view.own_colour)

    def _floor(self, ground: _Ground, origin: Floats, scene: Scene, row: int) -> Shades:
        """Colours [3, m]."""
        x, y, z = (np.float32(value) for value in origin)
        # A pixel's size on the floor, along its longer side.
        footprint = ground.depth * ground.fall
        footprint *= np.float32(2.0 / CAMERA_SIZE)
        colours = self._appearance.floor.paint(x + z * ground.run_x, y + z * ground.run_y, footprint)
        for kind in self._painted:
            _paint_discs(colours, kind, scene.things[kind.name], row, ground, origin)
        left = ground.depth * np.float32(1.0 / self._appearance.haze)
        left *= left
        left += _ONE
        np.divide(_ONE, left, out=left)
        horizon = column(self._appearance.horizon)
        colours -= horizon
        colours *= left
        colours += horizon
        return colours

    def _upright(self, frame: Frame, scene: Scene, row: int) -> tuple[NDArray[np.intp], Shades]:
        """Walls and columns: brings the depth up to date; the pixels [m] that see them and their colours [3, m]."""
        rays, depth = frame.rays, frame.depth
        x, y, z = (np.float32(value) for value in frame.origin)
        columns, layers = self._all_columns(scene, row)
        panorama = draw_panorama(join([self._walls, column_sides(columns, x, y)]), layers, x, y, column(self._appearance.horizon))
        step = directions(rays[0], rays[1]).astype(np.intp)
        step &= DIRECTIONS - 1
        # Length of a ray per length of the direction's vector on the square.
        stretch = np.maximum(np.abs(rays[0]), np.abs(rays[1]))
        np.maximum(stretch, np.float32(1e-6), out=stretch)
        np.divide(_ONE, stretch, out=stretch)
        place = np.full(len(depth), -1, np.intp)
        for layer in range(layers):
            away = np.take(panorama.reach[layer], step)
            away *= stretch
            height = away * rays[2]
            height += z
            seen = height <= np.take(panorama.top[layer], step)
            seen &= away < depth
            np.copyto(depth, away, where=seen)
            np.add(step, layer * DIRECTIONS, out=place, where=seen)
        pixels = np.flatnonzero(place >= 0)
        return pixels, np.take(panorama.colour, place[pixels], axis=1)

    def _all_columns(self, scene: Scene, row: int) -> tuple[Columns, int]:
        """Landmarks and things drawn as columns, and the number of layers: the walls' own, the landmarks', and one for each kind."""
        parts, layers = [self._landmarks], self._wall_layers + 1
        for kind in self._columns:
            assert kind.column is not None
            things = scene.things[kind.name]
            places = things.position[row, np.flatnonzero(things.shown[row]), :2]
            parts.append(make_columns(places, [kind.column] * len(places), [kind.colour] * len(places), layers))
            layers += 1
        return join(parts), layers


def _paint_discs(colours: Shades, kind: Kind, things: Things, row: int, ground: _Ground, origin: Floats) -> None:
    """Blend a kind's discs over the floor's colours [3, m]. Nothing tells from the picture whether a cost is being paid."""
    assert kind.painted is not None
    inside = np.zeros(len(ground.pixels), np.bool_)
    from_x, from_y, from_z = origin.tolist()
    for x, y, z in rounded(things.position[row, np.flatnonzero(things.shown[row])]).tolist():
        drop = from_z - z
        if drop > 0.0:
            dx = ground.run_x + np.float32((from_x - x) / drop)
            dy = ground.run_y + np.float32((from_y - y) / drop)
            dx *= dx
            dy *= dy
            dx += dy
            inside |= dx < np.float32((kind.painted / drop) ** 2)
    pixels = np.flatnonzero(inside)
    if len(pixels):
        mixed = np.take(colours, pixels, axis=1)
        mixed += np.float32(kind.alpha) * (column(kind.colour) - mixed)
        put(colours, pixels, mixed)
