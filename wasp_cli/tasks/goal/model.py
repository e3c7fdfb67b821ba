"""The bodies of Goal as MuJoCo models: a point robot, and light vases that can be pushed.

The robot's slide joints lie along the world axes, so that qpos[:3] is its world pose (x, y, yaw).
(The reference package turns the body by the start yaw instead; damping is isotropic, so the motion
is the same.) Goal and hazards touch nothing: they are no bodies.
"""

from __future__ import annotations

import mujoco

from wasp_cli.tasks.physics import body_sensor

TIMESTEP = 0.002

HAZARD_RADIUS = 0.2  # lengths are in m
GOAL_Z = 0.16
HAZARD_Z = 0.02
VASE_Z = 0.09996
VASE_HALF = 0.1  # half the side of a cube
AGENT_Z = 0.1
AGENT_RADIUS = 0.1
ARROW_X = 0.1  # in front of the agent's middle
ARROW_HALF = 0.05  # half the side of a cube

SPHERE_GEOM = (
    f'<geom name="agent" type="sphere" size="{AGENT_RADIUS}" density="1" friction="1 0.01 0.01"/>'
)
ARROW_GEOM = (
    f'<geom name="pointarrow" type="box" pos="{ARROW_X} 0 0" size="{ARROW_HALF} {ARROW_HALF} '
    f'{ARROW_HALF}" density="1"/>'
)
VASE_GEOM = f'<geom type="box" size="{VASE_HALF} {VASE_HALF} {VASE_HALF}" density="0.001"/>'

_AGENT = f"""
    <body name="agent" pos="0 0 {AGENT_Z}">
      <joint name="x" type="slide" axis="1 0 0" damping="0.01"/>
      <joint name="y" type="slide" axis="0 1 0" damping="0.01"/>
      <joint name="yaw" type="hinge" axis="0 0 1" damping="0.005"/>
      {SPHERE_GEOM}
      {ARROW_GEOM}
      <site name="agent"/>
    </body>"""

AGENT_SENSORS = 12  # numbers of accelerometer, velocimeter, gyro and magnetometer


def build_model(bodies: int, walls: int = 0, integrate: bool = True) -> mujoco.MjModel:
    """Build the robot and some vases; qpos = x, y (m), yaw (rad), then the vases' free joints.

    A robot alone needs no floor: it cannot fall, and its sphere touches the floor at distance 0,
    which exerts no force.
    """
    vases = "".join(
        f'<body name="vase{i}" pos="{2 * i + 2} 0 {VASE_Z}"><freejoint/>{VASE_GEOM}</body>'
        for i in range(bodies)
    )
    floor = '<geom name="floor" type="plane" size="3.5 3.5 0.1"/>' if bodies else ""
    flags = "" if bodies else '<flag constraint="disable" contact="disable"/>'
    touches = "".join(
        f'<contact name="{body_sensor(i)}" subtree1="agent" body2="vase{i}" data="found"/>'
        for i in range(bodies)
    )
    sensors = "".join(
        f'<{kind} site="agent"/>'
        for kind in ("accelerometer", "velocimeter", "gyro", "magnetometer")
    )
    # The turn servo is unstable at this timestep and chatters against its force limit. That is the
    # task: Euler keeps it explicit.
    return mujoco.MjModel.from_xml_string(
        f"""
<mujoco model="goal">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{TIMESTEP}" integrator="Euler">{flags}</option>
  <default><geom condim="6"/></default>
  <worldbody>
    {floor}{_AGENT}{vases}
  </worldbody>
  <actuator>
    <motor name="throttle" site="agent" gear="0.3 0 0 0 0 0" ctrlrange="-1 1" forcerange="-0.05 0.05"/>
    <velocity name="turn" joint="yaw" kv="1" gear="0.3" ctrlrange="-1 1" forcerange="-0.05 0.05"/>
  </actuator>
  <sensor>{"" if integrate else sensors + touches}</sensor>
</mujoco>"""
    )
