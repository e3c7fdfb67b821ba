"""What needs no ray cast at it: sky, floor with discs, walls, columns, the robot's own body.

P = 2 * 64 * 64 pixels, front image first; m = pixels that see the floor, or a wall.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import CAMERA_SIZE
from wasp_cli.tasks.camera.appearance import Appearance, Painter, Scene, Shades
from wasp_cli.tasks.camera.discs import Discs
from wasp_cli.tasks.camera.frame import FAR, Frame, Poses, View, column, turned_rays
from wasp_cli.tasks.camera.panorama import DIRECTIONS, NOTHING, Panorama, directions
from wasp_cli.tasks.camera.upright import Upright

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
# a layer with something in less than one of so many directions is looked at pixel by pixel
_SPARSE = 4


class _Ground(NamedTuple):
    """The pixels that see the floor. All of it depends on the cameras' height and tilt alone,
    not on where they are.
    """

    pixels: NDArray[np.intp]  # [m]
    fall: Shades  # [m] length of the ray on which it falls by 1 m
    paint: Painter  # of the floor, for the size of these pixels on it
    left: Shades  # [m] the share of the colour that haze leaves


class _Level(NamedTuple):
    """What a robot of one height and tilt sees of sky, floor and itself, wherever it is, where
    nothing stands upright.
    """

    tilt: bytes  # of the pose that this was made for
    depth: Shades  # [P]
    image: Shades  # [3, P] sky and the robot itself
    ground: _Ground
    rays: Shades  # [3, m] of the floor's pixels, in the robot's frame


class _Fall(NamedTuple):
    """How far every ray goes until it meets the floor."""

    depth: Shades  # [P] in m; very large above the horizon
    per_metre: Shades  # [P] length of the ray on which it falls by 1 m


class Ahead(NamedTuple):
    """What is computed for all rows of a scene at once, before any pixel is."""

    panoramas: list[Panorama] | None  # None: nothing stands upright
    discs: list[Discs]  # of each kind that is painted onto the floor


class Backdrop:
    """Draws it for one appearance and the view of its robot."""

    def __init__(self, appearance: Appearance, view: View) -> None:
        self._view = view
        self._floor = appearance.floor
        self._haze = appearance.haze
        self._upright = Upright(appearance)
        self._painted = [kind for kind in appearance.kinds if kind.painted is not None]
        self._horizon = column(appearance.horizon)
        self._zenith = column(appearance.zenith)
        self._level: _Level | None = None

    def look_ahead(self, poses: Poses, scene: Scene) -> Ahead:
        """Return what `draw` needs to know of all rows of a scene."""
        panoramas = self._upright.panoramas(poses, scene)
        discs = [Discs(kind, poses, scene.things[kind.name]) for kind in self._painted]
        return Ahead(panoramas, discs)

    def draw(self, frame: Frame, ahead: Ahead, row: int) -> None:
        """Fill every pixel of a frame with what is behind the things of one row, in image and
        depth (m).
        """
        if ahead.panoramas is None:
            level = self._level_view(frame)
            np.copyto(frame.depth, level.depth)
            np.copyto(frame.image, level.image)
            run = turned_rays(frame.turn[:2], level.rays)
            self._draw_floor(frame, level.ground, run, ahead, row)
        else:
            rays = frame.rays()
            fall = _to_floor(frame, rays[2])
            pixels, colours = _see_upright(frame, rays, ahead.panoramas[row])
            frame.put(pixels, colours)
            # Where nothing upright is nearer than the floor.
            ground = self._ground(np.flatnonzero(frame.depth == fall.depth), fall)
            run = np.take(rays[:2], ground.pixels, axis=1)
            self._draw_floor(frame, ground, run, ahead, row)
            self._draw_sky_and_robot(frame, rays[2])

    def _level_view(self, frame: Frame) -> _Level:
        """What depends on height and tilt alone: computed again only where those differ from those
        of the frame before.
        """
        tilt = frame.turn[2].tobytes() + frame.origin[2].tobytes()
        level = self._level
        if level is None or level.tilt != tilt:
            height = frame.rays()[2]
            fall = _to_floor(frame, height)
            sees_floor = (frame.depth == fall.depth) & (frame.depth < np.float32(FAR))
            sees_floor[self._view.own] = False
            ground = self._ground(np.flatnonzero(sees_floor), fall)
            self._draw_sky_and_robot(frame, height)
            level = _Level(
                tilt=tilt,
                depth=frame.depth.copy(),
                image=frame.image.copy(),
                ground=ground,
                rays=np.take(frame.body_rays, ground.pixels, axis=1),
            )
            self._level = level
        return level

    def _ground(self, pixels: NDArray[np.intp], fall: _Fall) -> _Ground:
        """What is known of the pixels [m] that see the floor."""
        depth = fall.depth[pixels]
        per_metre = fall.per_metre[pixels]
        # A pixel's size on the floor, along its longer side.
        footprint = depth * per_metre
        footprint *= np.float32(2.0 / CAMERA_SIZE)
        # The share of its colour that haze leaves: 1 / (1 + (depth / haze)^2).
        left = depth * np.float32(1.0 / self._haze)
        left *= left
        left += _ONE
        np.divide(_ONE, left, out=left)
        return _Ground(pixels, per_metre, self._floor.painter(footprint), left)

    def _draw_floor(
        self, frame: Frame, ground: _Ground, run: Shades, ahead: Ahead, row: int
    ) -> None:
        """Draw the floor, its discs and its haze into a frame.

        `run` [2, m] are x and y of the rays to the floor's pixels; it is scaled here, in place, to
        how far they go while they fall by 1 m.
        """
        if not len(ground.pixels):
            return
        run *= ground.fall
        x, y, z = frame.origin.astype(np.float32)
        colours = ground.paint(x + z * run[0], y + z * run[1])
        for discs in ahead.discs:
            discs.paint(colours, row, ground.pixels, run)
        colours -= self._horizon
        colours *= ground.left
        colours += self._horizon
        frame.put(ground.pixels, colours)

    def _draw_sky_and_robot(self, frame: Frame, height: Shades) -> None:
        """Draw the sky, whose colours go by the rays' rise `height` [P], and the robot's body."""
        pixels = np.flatnonzero(frame.depth >= np.float32(FAR))
        rise = height[pixels]
        rise *= np.float32(2.0)
        np.maximum(rise, _ZERO, out=rise)
        np.minimum(rise, _ONE, out=rise)
        colours = (self._zenith - self._horizon) * rise
        colours += self._horizon
        frame.put(pixels, colours)
        frame.put(self._view.own, self._view.own_colour)


def _to_floor(frame: Frame, height: Shades) -> _Fall:
    """How far the rays, whose z is `height` [P], go to the floor; the frame's depth becomes that
    where it is nearer.
    """
    # Rays above the horizon meet it so far away that it never counts.
    per_metre = np.negative(height)
    np.maximum(per_metre, np.float32(1e-6), out=per_metre)
    np.divide(_ONE, per_metre, out=per_metre)
    depth: Shades = np.float32(frame.origin[2]) * per_metre
    np.minimum(frame.depth, depth, out=frame.depth)
    return _Fall(depth, per_metre)


def _see_upright(frame: Frame, rays: Shades, panorama: Panorama) -> tuple[NDArray[np.intp], Shades]:
    """The pixels [m] that see walls and columns, and their colours [3, m]; the frame's depth
    becomes that of these.
    """
    depth = frame.depth
    z = np.float32(frame.origin[2])
    # The direction of every ray on the panorama's square.
    at, stretch = directions(rays[0], rays[1])
    step = (at.astype(np.int32) & (DIRECTIONS - 1)).astype(np.intp)
    # Length of a ray per length of the direction's vector on the square.
    np.maximum(stretch, np.float32(1e-6), out=stretch)
    np.divide(_ONE, stretch, out=stretch)
    # By pixel, where in the panorama's colours what it sees is; -1: nothing there.
    place = np.full(len(depth), -1, np.intp)
    for layer, (reach, top) in enumerate(zip(panorama.reach, panorama.top, strict=True)):
        there = reach < NOTHING
        if np.count_nonzero(there) < DIRECTIONS // _SPARSE:
            # Few directions have anything: only their pixels.
            some = np.flatnonzero(np.take(there, step))
            towards = step[some]
            away = np.take(reach, towards)
            away *= stretch[some]
            height = away * rays[2][some]
            height += z
            seen = height <= np.take(top, towards)
            seen &= away < depth[some]
            chosen = np.flatnonzero(seen)
            pixels = some[chosen]
        else:
            away = np.take(reach, step)
            away *= stretch
            height = away * rays[2]
            height += z
            seen = height <= np.take(top, step)
            seen &= away < depth
            chosen = np.flatnonzero(seen)
            pixels = chosen
        depth[pixels] = away[chosen]
        place[pixels] = step[pixels] + layer * DIRECTIONS
    pixels = np.flatnonzero(place >= 0)
    return pixels, np.take(panorama.colour, place[pixels], axis=1)
