"""The car of Race and Formula One: two driven wheels at the back, a ball caster under the front,
which is body -y.

qpos (13) = position, quaternion, left and right wheel, caster quaternion; qvel (11) accordingly.
"left" sits at -x, which is the driver's right: the action (1, -1) turns counter-clockwise.
"""

from __future__ import annotations

import numpy as np

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.camera.appearance import Part
from wasp_cli.tasks.features import lidars
from wasp_cli.tasks.frames import ground_to_body, quaternion_rotation, yaw_quaternion

TIMESTEP = 0.004
CAR_Z = 0.1
NQ = 13
NV = 11
SENSORS = 19
"""Numbers of accelerometer, velocimeter, gyro, magnetometer (3 each), caster angular velocity
(3) and caster quaternion (4).
"""
STATE_SENSORS = 24  # the same with the caster's rotation as a matrix

# of the upright cylinder around the body's origin that holds the car (the wheels' corners), in m
RADIUS = 0.22
REACH = RADIUS + 0.04  # the same after an env step, in which the car drives at most 0.04 m

CHASSIS_GEOMS = (
    '<geom name="agent" type="box" size="0.1 0.1 0.05"/>',
    '<geom name="back_bumper" type="box" pos="0 0.15 0" size="0.1 0.01 0.05"/>',
    '<geom name="back_connector" type="box" pos="0 0.125 0" size="0.01 0.025 0.03"/>',
    '<geom name="front_bumper" type="box" pos="0 -0.165 0" size="0.05 0.01 0.05"/>',
    '<geom name="front_connector" type="box" pos="0 -0.13 0.04" size="0.05 0.03 0.01"/>',
)
_CAR = f"""
    <body name="agent" pos="0 0 {CAR_Z}">
      <freejoint name="agent"/>
      {"".join(geom.replace("<geom", '<geom density="5"') for geom in CHASSIS_GEOMS)}
      <site name="agent"/>
      <body name="left" pos="-0.1 0.1 -0.05">
        <joint name="left" type="hinge" axis="1 0 0" damping="0.001"/>
        <geom name="left" type="cylinder" fromto="-0.055 0 0 -0.005 0 0" size="0.05" density="5"/>
      </body>
      <body name="right" pos="0.1 0.1 -0.05">
        <joint name="right" type="hinge" axis="1 0 0" damping="0.001"/>
        <geom name="right" type="cylinder" fromto="0.005 0 0 0.055 0 0" size="0.05" density="5"/>
      </body>
      <body name="rear" pos="0 -0.1 -0.05">
        <joint name="rear" type="ball" damping="0.001"/>
        <geom name="rear" type="sphere" size="0.05" density="5"/>
      </body>
    </body>"""

_SENSORS = """
    <accelerometer site="agent"/><velocimeter site="agent"/><gyro site="agent"/><magnetometer site="agent"/>
    <ballangvel joint="rear"/><ballquat joint="rear"/>"""


def car_mjcf(
    integrator: str, *, others: str = "", assets: str = "", sensors: str | None = None
) -> str:
    """Return the car on a floor as MJCF.

    Args:
        integrator: of MuJoCo.
        others: MJCF of further bodies.
        assets: MJCF of their meshes.
        sensors: MJCF of sensors after the car's own; None: no sensors at all.

    Sensors are read without a warm start, from which the solver may stop early: they get a finer
    tolerance.
    """
    tolerance = 1e-8 if sensors is None else 1e-12
    all_sensors = "" if sensors is None else _SENSORS + sensors
    return f"""
<mujoco model="car">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{TIMESTEP}" integrator="{integrator}" tolerance="{tolerance}"><flag island="disable"/></option>
  <default><geom condim="6"/></default>
  <asset>{assets}</asset>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    {_CAR}{others}
  </worldbody>
  <actuator>
    <motor name="left" joint="left" ctrlrange="-1 1" forcerange="-0.02 0.02"/>
    <motor name="right" joint="right" ctrlrange="-1 1" forcerange="-0.02 0.02"/>
  </actuator>
  <sensor>{all_sensors}</sensor>
</mujoco>"""


def start_pose(xy: Floats, yaw: float) -> Floats:
    """Return qpos [13] of a car at rest at `xy` [2] in m; `yaw` in rad is of the body's x axis."""
    pose = np.zeros(NQ)
    pose[:2] = xy
    pose[2] = CAR_Z
    pose[3:7] = yaw_quaternion(np.array(yaw))
    pose[9] = 1.0
    return pose


def rotation(qpos: Floats) -> Floats:
    """Return body to world [n, 3, 3] of cars in states [n, 13]."""
    return quaternion_rotation(qpos[:, 3:7])


def heading(qpos: Floats) -> Floats:
    """Return the direction [n] of the cars' front in rad, of states [n, 13]."""
    w, x, y, z = qpos[:, 3:7].T
    # The world direction of body -y.
    front: Floats = np.arctan2(-(w * w - x * x + y * y - z * z), -2.0 * (x * y - w * z))
    return front


def state_vector(sensors: Floats, qpos: Floats, *seen: Floats) -> Floats:
    """Join float64 [B, 24 + 16 J]: the sensors with the caster's rotation as a matrix, then a lidar
    for each group of points.

    Args:
        sensors: [B, 19].
        qpos: [B, 13].
        seen: J arrays [B, K, 2] of world points on the ground, in m.
    """
    caster = quaternion_rotation(sensors[:, 15:19]).reshape(-1, 9)
    around = ground_to_body(np.concatenate(seen, axis=1), qpos[:, :3], rotation(qpos))
    lidar = lidars(around, [points.shape[1] for points in seen])
    return np.concatenate([sensors[:, :15], caster, lidar], axis=1)


CAMERA_HEIGHT = 0.2  # above the body's origin, in m
FORWARD = (0.0, -1.0)  # of the front camera, in the body frame

_RED = (0.7412, 0.0431, 0.1843)
_BLUE = (0.0039, 0.1529, 0.3961)
_BODY, *_BUMPERS = CHASSIS_GEOMS
# Wheels do not show that they spin: they are as still as the rest.
_WHEELS = (
    '<geom type="cylinder" fromto="-0.155 0.1 -0.05 -0.105 0.1 -0.05" size="0.05"/>',
    '<geom type="cylinder" fromto="0.105 0.1 -0.05 0.155 0.1 -0.05" size="0.05"/>',
    '<geom type="sphere" pos="0 -0.1 -0.05" size="0.05"/>',
)

CAR_PARTS = (
    *(Part(geom, _RED) for geom in (*_WHEELS, _BODY)),
    *(Part(geom, _BLUE) for geom in _BUMPERS),
)
"""Lowest first, all in the frame of the car's body."""
