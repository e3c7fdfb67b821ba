"""The bodies of Goal1 as a MuJoCo model: a point robot, a light vase that can be pushed, a goal and hazards without contact.

The robot's slide joints lie along the world axes, so that qpos[:3] is its world pose (x, y, yaw). (The reference package turns the
body by the start yaw instead; damping is isotropic, so the motion is the same.)
"""

from __future__ import annotations

import mujoco

TIMESTEP = 0.002
PHYSICS_STEPS = 10
"""Physics steps per env step."""

HAZARDS = 8
GOAL_RADIUS, GOAL_HALF_HEIGHT, GOAL_Z = 0.3, 0.15, 0.16
HAZARD_RADIUS, HAZARD_HALF_HEIGHT, HAZARD_Z = 0.2, 0.01, 0.02
VASE_HALF, VASE_Z = 0.1, 0.09996
AGENT_Z, AGENT_RADIUS = 0.1, 0.1
ARROW_X, ARROW_HALF = 0.1, 0.05

AGENT_GROUP, OPAQUE_GROUP, GOAL_GROUP, HAZARD_GROUP = 1, 2, 3, 4
"""Geom groups: what a camera ray can be asked to hit."""

_AGENT = f"""
    <body name="agent" pos="0 0 {AGENT_Z}">
      <joint name="x" type="slide" axis="1 0 0" damping="0.01"/>
      <joint name="y" type="slide" axis="0 1 0" damping="0.01"/>
      <joint name="yaw" type="hinge" axis="0 0 1" damping="0.005"/>
      <geom name="agent" type="sphere" size="{AGENT_RADIUS}" density="1" friction="1 0.01 0.01" group="{AGENT_GROUP}"/>
      <geom name="pointarrow" type="box" pos="{ARROW_X} 0 0" size="{ARROW_HALF} {ARROW_HALF} {ARROW_HALF}" density="1"
            group="{AGENT_GROUP}"/>
      <site name="agent"/>
    </body>"""

_VASE = f"""
    <body name="vase" pos="0 0 {VASE_Z}">
      <freejoint name="vase"/>
      <geom name="vase" type="box" size="{VASE_HALF} {VASE_HALF} {VASE_HALF}" density="0.001" group="{OPAQUE_GROUP}"/>
    </body>"""

_GOAL = f"""
    <body name="goal" mocap="true" pos="0 0 {GOAL_Z}">
      <geom name="goal" type="cylinder" size="{GOAL_RADIUS} {GOAL_HALF_HEIGHT}" contype="0" conaffinity="0" group="{GOAL_GROUP}"/>
    </body>"""


def _hazard(index: int) -> str:
    return f"""
    <body name="hazard{index}" mocap="true" pos="0 0 {HAZARD_Z}">
      <geom name="hazard{index}" type="cylinder" size="{HAZARD_RADIUS} {HAZARD_HALF_HEIGHT}" contype="0" conaffinity="0"
            group="{HAZARD_GROUP}"/>
    </body>"""


_FLOOR = '<geom name="floor" type="plane" size="3.5 3.5 0.1"/>'

_SENSORS = """
  <sensor>
    <accelerometer site="agent"/><velocimeter site="agent"/><gyro site="agent"/><magnetometer site="agent"/>
  </sensor>"""


def _mjcf(bodies: str, flags: str = "", sensors: str = "") -> str:
    # The turn servo is unstable at this timestep and chatters against its force limit. That is the task: Euler keeps it explicit.
    return f"""
<mujoco model="goal1">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{TIMESTEP}" integrator="Euler">{flags}</option>
  <default><geom condim="6"/></default>
  <worldbody>
    {bodies}
  </worldbody>
  <actuator>
    <motor name="throttle" site="agent" gear="0.3 0 0 0 0 0" ctrlrange="-1 1" forcerange="-0.05 0.05"/>
    <velocity name="turn" joint="yaw" kv="1" gear="0.3" ctrlrange="-1 1" forcerange="-0.05 0.05"/>
  </actuator>{sensors}
</mujoco>"""


def full_model() -> mujoco.MjModel:
    """Everything: qpos = agent x, y, yaw, then the vase's free joint; mocap bodies = goal, then the hazards."""
    return mujoco.MjModel.from_xml_string(_mjcf(_FLOOR + _AGENT + _VASE + _GOAL + "".join(map(_hazard, range(HAZARDS))), sensors=_SENSORS))


def lone_agent_model() -> mujoco.MjModel:
    """The agent alone, for steps in which the vase rests out of reach: the same motion, four times as fast.

    It needs no floor: the agent cannot fall, and its sphere touches the floor at distance 0, which exerts no force.
    """
    return mujoco.MjModel.from_xml_string(_mjcf(_AGENT, flags='<flag constraint="disable" contact="disable"/>'))
