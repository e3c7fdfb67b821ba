"""The bodies of Race as MuJoCo models: the car, and nine prisms that it can touch. Bushes and goal touch nothing: they are no bodies."""

from __future__ import annotations

import mujoco

from wasp_cli.tasks.car import car_mjcf
from wasp_cli.tasks.local_physics import STATIC_SENSOR
from wasp_cli.tasks.race.scenery import SCENERY, Prism


def build_model(bodies: int, walls: int, integrate: bool) -> mujoco.MjModel:
    """The car, with or without the scenery."""
    if bodies:
        raise ValueError("Race has no free bodies")
    assets = "".join(_mesh(prism) for prism in SCENERY) if walls else ""
    geoms = "".join(f'<geom name="{prism.name}" type="mesh" mesh="{prism.name}"/>' for prism in SCENERY)
    others = f'<body name="scenery">{geoms}</body>' if walls else ""
    touches = f'<contact name="{STATIC_SENSOR}" subtree1="agent" body2="scenery" data="found"/>' if walls else ""
    return mujoco.MjModel.from_xml_string(car_mjcf("Euler", others=others, assets=assets, sensors=None if integrate else touches))


def _mesh(prism: Prism) -> str:
    corners = " ".join(f"{x} {y} {z}" for z in (prism.bottom, prism.top) for x, y in prism.outline.tolist())
    return f'<mesh name="{prism.name}" vertex="{corners}"/>'
