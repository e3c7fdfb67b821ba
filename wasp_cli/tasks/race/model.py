"""The bodies of Race as MuJoCo models: the car, and nine solid, upright prisms, of which it can
touch every one.

Bushes and goal touch nothing: they are no bodies. Outlines of the prisms are in m, world frame, at
the height of the car; they are the convex hulls of the reference package's scenery in the band 0.05
m <= z <= 0.15 m, to 0.01 m. The south faces of the two upper fences, along which a recorded car
rubs, are measured from its contacts to 0.3 mm.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.car import car_mjcf
from wasp_cli.tasks.outline import parse_outline
from wasp_cli.tasks.physics import STATIC_SENSOR


class Prism(NamedTuple):
    """An upright convex solid."""

    name: str
    kind: str  # `fence`, `rock`, `door` or `stone`: how it looks
    bottom: float
    top: float  # heights in m
    outline: Floats  # [V, 2] corners in order around


SCENERY = (
    Prism(
        "race_wall1_down",
        "fence",
        -0.1,
        1.22,
        parse_outline(
            """
            -2.77,-3.33 -2.81,-3.31 -2.88,-3.18 -2.95,-1.76 -2.96,-0.90 -2.94,-0.81 -2.90,-0.79 -2.85,-0.80 -2.77,-0.86
            -2.75,-0.90 -2.69,-1.42 -2.68,-2.74 -2.70,-3.19 -2.73,-3.30
            """
        ),
    ),
    Prism(
        "race_wall1_up",
        "fence",
        -0.1,
        1.22,
        parse_outline(
            """
            -2.77,-0.87 -2.81,-0.86 -2.88,-0.73 -2.95,0.69 -2.96,1.56 -2.94,1.65 -2.90,1.67 -2.85,1.66 -2.77,1.59 -2.75,1.55
            -2.69,1.04 -2.68,-0.28 -2.70,-0.74 -2.73,-0.85
            """
        ),
    ),
    Prism(
        "race_wall2_left",
        "fence",
        -0.1,
        1.22,
        parse_outline(
            """
            -1.69,1.6255 -2.14,1.6517 -2.25,1.68 -2.27,1.70 -2.27,1.74 -2.25,1.77 -2.13,1.83 -0.71,1.90 0.15,1.91 0.24,1.89
            0.26,1.85 0.25,1.80 0.18,1.72 0.15,1.70 -0.36,1.64
            """
        ),
    ),
    Prism(
        "race_wall22_right",
        "fence",
        -0.1,
        1.22,
        parse_outline(
            """
            1.11,1.6255 0.66,1.6517 0.55,1.68 0.53,1.70 0.53,1.74 0.55,1.77 0.67,1.83 2.09,1.90 2.95,1.91 3.04,1.89 3.06,1.85
            3.05,1.80 2.98,1.72 2.95,1.70 2.44,1.64
            """
        ),
    ),
    Prism(
        "race_wall3",
        "rock",
        -0.79,
        0.79,
        parse_outline(
            """
            0.69,-0.97 -0.27,-0.97 -1.48,-0.89 -1.92,-0.84 -2.49,-0.70 -2.64,-0.64 -2.68,-0.61 -2.74,-0.07 -2.74,-0.00
            -2.46,0.17 -1.74,0.46 -1.41,0.56 -1.26,0.59 0.63,0.60 2.12,0.47 2.52,0.42 2.78,0.37 2.94,0.31 3.18,0.06 3.11,-0.50
            3.02,-0.59 2.88,-0.67 2.20,-0.86 1.28,-0.96
            """
        ),
    ),
    Prism(
        "race_wall4",
        "rock",
        -2.3,
        2.3,
        parse_outline(
            """
            0.65,-4.77 -0.60,-4.73 -1.27,-4.38 -1.51,-4.16 -1.71,-3.87 -1.76,-3.53 -1.77,-2.74 -1.71,-1.58 -1.67,-1.20
            -1.65,-1.13 -1.28,-0.76 -1.15,-0.64 -0.46,-0.21 0.52,-0.17 1.71,-0.17 1.87,-0.25 2.49,-0.66 2.93,-1.11 2.97,-1.17
            3.04,-2.23 3.07,-3.06 3.04,-3.67 3.00,-3.75 2.56,-4.38 2.08,-4.64 1.95,-4.70 1.69,-4.73
            """
        ),
    ),
    Prism(
        "race_wall5",
        "door",
        0.0,
        2.14,
        parse_outline(
            """
            -1.75,-3.56 -2.86,-3.57 -2.87,-3.56 -2.87,-3.44 -1.75,-3.44
            """
        ),
    ),
    Prism(
        "small_stone1",
        "stone",
        -0.28,
        0.28,
        parse_outline(
            """
            -2.43,1.80 -2.82,1.84 -2.91,1.94 -2.92,2.07 -2.92,2.23 -2.85,2.34 -2.77,2.37 -2.56,2.40 -2.18,2.39 -2.07,2.33
            -1.99,2.23 -1.97,2.20 -1.98,1.99 -2.02,1.93 -2.12,1.83 -2.17,1.81
            """
        ),
    ),
    Prism(
        "small_stone2",
        "stone",
        -0.48,
        0.48,
        parse_outline(
            """
            0.25,1.82 0.15,1.86 0.06,1.97 0.06,2.06 0.07,2.29 0.17,2.36 0.52,2.38 0.60,2.32 0.64,2.26 0.65,2.11 0.65,1.95
            0.58,1.88
            """
        ),
    ),
)


def build_model(bodies: int, walls: int, integrate: bool) -> mujoco.MjModel:
    """Build the car, with or without the scenery (`walls` 1 or 0). Raises ValueError for free
    bodies, of which Race has none.
    """
    if bodies:
        raise ValueError("Race has no free bodies")
    assets = "".join(_mesh(prism) for prism in SCENERY) if walls else ""
    geoms = "".join(
        f'<geom name="{prism.name}" type="mesh" mesh="{prism.name}"/>' for prism in SCENERY
    )
    others = f'<body name="scenery">{geoms}</body>' if walls else ""
    touches = ""
    if walls:
        touches = f'<contact name="{STATIC_SENSOR}" subtree1="agent" body2="scenery" data="found"/>'
    sensors = None if integrate else touches
    return mujoco.MjModel.from_xml_string(
        car_mjcf("Euler", others=others, assets=assets, sensors=sensors)
    )


def _mesh(prism: Prism) -> str:
    """MJCF of a prism's mesh: its convex hull."""
    corners = []
    for z in (prism.bottom, prism.top):
        corners += [f"{x} {y} {z}" for x, y in prism.outline.tolist()]
    return f'<mesh name="{prism.name}" vertex="{" ".join(corners)}"/>'
