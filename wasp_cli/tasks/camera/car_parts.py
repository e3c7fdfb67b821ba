"""The car of Race and Formula One as its cameras see it."""

from __future__ import annotations

from wasp_cli.tasks.camera.look import Part
from wasp_cli.tasks.car import CHASSIS_GEOMS

CAMERA_HEIGHT = 0.2
FORWARD = (0.0, -1.0)

_RED, _BLUE = (0.7412, 0.0431, 0.1843), (0.0039, 0.1529, 0.3961)
_BODY, *_BUMPERS = CHASSIS_GEOMS
# Wheels do not show that they spin: they are as still as the rest.
_WHEELS = (
    '<geom type="cylinder" fromto="-0.155 0.1 -0.05 -0.105 0.1 -0.05" size="0.05"/>',
    '<geom type="cylinder" fromto="0.105 0.1 -0.05 0.155 0.1 -0.05" size="0.05"/>',
    '<geom type="sphere" pos="0 -0.1 -0.05" size="0.05"/>',
)

CAR_PARTS = (*(Part(geom, _RED) for geom in (*_WHEELS, _BODY)), *(Part(geom, _BLUE) for geom in _BUMPERS))
"""Lowest first, all in the frame of the car's body."""
