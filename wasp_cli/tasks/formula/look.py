"""What Formula One looks like: a striped circuit with chevrons, barriers of two colours, towers to tell places by.

Seen forward, the outer barrier (red and white) is always on the left and the inner one (blue and white) on the right.
"""

from __future__ import annotations

from functools import lru_cache

from wasp_cli.tasks.camera.car_parts import CAMERA_HEIGHT, CAR_PARTS, FORWARD
from wasp_cli.tasks.camera.look import Kind, Landmark, Look, Wall
from wasp_cli.tasks.formula import track
from wasp_cli.tasks.formula.ground import Ground

_WALL_TOP = 0.6
"""Lower than what the car collides with (invisible in the reference package), so that beacon and towers are seen over it."""
_BEACON_RADIUS, _BEACON_TOP = 0.3, 3.0
_BARREL_REACH = 15.0

_WHITE = (0.92, 0.92, 0.92)
_LANDMARKS = (
    Landmark((6.0, 21.0), 0.8, 6.0, (0.85, 0.10, 0.10)),
    Landmark((19.0, 9.0), 0.8, 6.0, (1.00, 0.55, 0.00)),
    Landmark((33.0, 6.0), 0.8, 6.0, (0.98, 0.90, 0.10)),
    Landmark((43.0, -6.0), 0.8, 6.0, (0.45, 0.85, 0.10)),
    Landmark((33.0, -16.0), 0.8, 6.0, (0.05, 0.40, 0.15)),
    Landmark((22.0, -4.8), 0.6, 4.0, (0.10, 0.75, 0.75)),
    Landmark((22.0, -32.0), 0.8, 6.0, (0.10, 0.25, 0.90)),
    Landmark((3.0, -42.0), 0.8, 6.0, (0.50, 0.10, 0.75)),
    Landmark((-19.0, -38.0), 0.8, 6.0, (0.30, 0.15, 0.05)),
    Landmark((-14.0, -18.0), 0.8, 6.0, (0.95, 0.95, 0.95)),
    Landmark((-7.0, 4.0), 0.8, 6.0, (0.05, 0.05, 0.08)),
    Landmark((10.0, -14.2), 0.4, 4.0, (0.95, 0.60, 0.60)),
)


@lru_cache
def look(level: int) -> Look:
    """Of level 0 (no barrels) or 1."""
    beacon = f'<geom type="cylinder" pos="0 0 {_BEACON_TOP / 2}" size="{_BEACON_RADIUS} {_BEACON_TOP / 2}"/>'
    goal = Kind("goal", beacon, (1.0, 0.0, 1.0), column=(_BEACON_RADIUS, _BEACON_TOP))
    barrel = "".join(
        f'<geom type="cylinder" pos="0 0 {(low + high) / 2:.4f}" size="{radius} {(high - low) / 2:.4f}"/>'
        for radius, low, high in ((0.162, 0.0, 0.05), (0.146, 0.05, 0.14), (0.124, 0.14, 0.25), (0.1, 0.25, 0.375))
    )
    vase = Kind("vase", barrel, (1.00, 0.40, 0.00), reach=_BARREL_REACH)
    return Look(
        robot=CAR_PARTS,
        camera_height=CAMERA_HEIGHT,
        forward=FORWARD,
        floor=Ground(),
        walls=(
            Wall(track.OUTER_BARRIER, _WALL_TOP, ((0.72, 0.05, 0.08), _WHITE), 1.0, hollow=True),
            Wall(track.INNER_BARRIER, _WALL_TOP, ((0.10, 0.20, 0.80), _WHITE), 1.0),
            Wall(track.PIT_WALL, _WALL_TOP, ((0.95, 0.80, 0.05), (0.15, 0.15, 0.15)), 1.0),
        ),
        landmarks=_LANDMARKS,
        kinds=(goal,) if level == 0 else (goal, vase),
        map_half_side=26.5,
        map_centre=(11.4, -10.8),
        # A bright sky, in which dark and bright towers are seen alike; haze of a clear day.
        horizon=(0.66, 0.75, 0.85),
        zenith=(0.38, 0.54, 0.80),
        haze=40.0,
    )
