"""Goal1 against recordings of the reference package's SafetyPointGoal1-v0.

Motion is compared one env step at a time from recorded states ("teacher-forced"): the turn servo is
chaotic, so that two correct implementations drift apart within some 50 steps. T = steps of the
recording, S = recorded states.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.conformance import comparison
from tests.conformance.comparison import (
    Check,
    Recording,
    check_ends,
    check_numbers,
    compare,
    errors,
    mean_ratio,
    meta_of,
    path_means,
)
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.frames import quaternion_rotation, wrapped
from wasp_cli.tasks.goal.model import HAZARD_RADIUS, build_model
from wasp_cli.tasks.goal.task import Goal

XY, YAW, VASE = 2e-5, 5e-5, 2e-3
"""m, rad, m. The vase weighs 8 mg: what differs is how far it jumps within a step in which it
is hit.
"""

_Snapshot = dict[str, NDArray[Any]]


def check_point_goal(recording: Recording) -> list[Check]:
    """Check layout, motion, reward, cost, observations and goals of one recorded episode."""
    return (
        _numbers(recording)
        + _layout(recording)
        + _motion(recording)
        + _observations(recording)
        + _goals(recording)
    )


def _numbers(r: Recording) -> list[Check]:
    return check_numbers(r, Goal(1, observe=()), build_model(1), HAZARD_RADIUS)


def _layout(r: Recording) -> list[Check]:
    task = Goal(1, observe=())
    task.reset([meta_of(r)["seed"]])
    start = task.snapshot()
    pairs = {
        "agent_xy": start["qpos"][0, :2],
        "agent_rot": start["qpos"][0, 2],
        "goal_xy": start["goal"][0],
        "hazards_xy": start["hazards"][0],
        "vases_xy": start["bodies"][0, :, :2],
    }
    turned = quaternion_rotation(start["bodies"][0, :, 3:])
    yaw = wrapped(np.arctan2(turned[:, 1, 0], turned[:, 0, 0]) - r["layout_vases_yaw"])
    checks = [
        compare(f"layout {name}", ours, r[f"layout_{name}"], 0.0) for name, ours in pairs.items()
    ]
    return [*checks, compare("layout vases_yaw", yaw, np.zeros_like(yaw), comparison.ANGLE)]


def _motion(r: Recording) -> list[Check]:
    index = r["state_idx"].astype(np.intp)
    if not index.size:
        return []
    task, forced = _forced(r)
    task.restore(forced)
    step = task.step(r["action"][index])
    after = task.snapshot()
    qpos = after["qpos"]
    # Where the vase is hit, the reward inherits the error of the position.
    hit = r["n_vase_contacts"][index] + r["n_vase_contacts"][np.maximum(index - 1, 0)] > 0
    hit |= np.abs(forced["speeds"][:, 0]).max(axis=1) > 1e-3
    off = np.abs(step.reward - r["reward"][index])
    turn = wrapped(qpos[:, 2] - r["yaw"][index])
    return [
        compare("xy after one step", qpos[:, :2], r["xy"][index], XY),
        compare("yaw after one step", turn, np.zeros_like(turn), YAW),
        compare("vase xy after one step", after["bodies"][:, 0, :2], r["vases_xy"][index, 0], VASE),
        *errors(
            ("reward, vase untouched", off, ~hit, comparison.REWARD),
            ("reward, vase hit", off, hit, XY),
        ),
        compare("cost", step.cost_env, r["cost"][index], 0.0),
        compare("goal met", step.goals, r["goal_met"][index], 0.0),
    ]


def _observations(r: Recording) -> list[Check]:
    # An observation after action t belongs to the state before action t + 1, where that was
    # recorded too.
    index, seen = r["state_idx"].astype(np.intp), r["obs_idx"].astype(np.intp)
    which = np.flatnonzero(np.isin(seen + 1, index))
    if not which.size:
        return []
    before, at = seen[which], np.searchsorted(index, seen[which] + 1)
    task, forced = _forced(r)
    forced = {name: array.copy() for name, array in forced.items()}
    for name in ("qpos", "qvel", "bodies", "speeds"):
        forced[name][: len(at)] = forced[name][at]
    forced["goal"][: len(at)] = r["goal_after"][before]
    forced["control"][: len(at)] = np.clip(r["action"][before].astype(np.float64), -1.0, 1.0)
    state = task.restore(forced).state
    ours, theirs = state[: len(at)], r["obs"][which]
    meta = meta_of(r)
    checks, start = [], 0
    for name, size in zip(meta["obs_keys"], meta["obs_dims"], strict=True):
        part = slice(start, start + size)
        checks.append(
            compare(
                name,
                ours[:, part],
                theirs[:, part],
                comparison.LIDAR if name.endswith("lidar") else comparison.SENSORS,
            )
        )
        start += size
    return checks


def _goals(r: Recording) -> list[Check]:
    """Step through the whole episode, each step from the recorded position; goals and their
    moves must agree exactly.
    """
    task = Goal(1, action_repeat=1, observe=())
    task.reset([meta_of(r)["seed"]])
    steps, goals = [], []
    for t, action in enumerate(r["action"]):
        forced = task.snapshot()
        if t > 0:
            forced["qpos"][0, :2], forced["qpos"][0, 2] = r["xy"][t - 1], r["yaw"][t - 1]
            forced["bodies"][0, 0, :2] = r["vases_xy"][t - 1, 0]
            forced["qvel"][0, :2], forced["qvel"][0, 2] = r["vel"][t - 1, :2], r["omega"][t - 1, 2]
        task.restore(forced)
        step = task.step(action[None])
        steps.append(step)
        goals.append(task.snapshot()["goal"][0])
        if step.ended[0]:
            break
    costs, length = [step.sources["hazards"][0] for step in steps], len(steps)
    column = meta_of(r)["cost_keys"].index("cost_hazards")
    return [
        *check_ends(r, steps, goals),
        compare("cost, all steps", costs, r["cost"][:length], 0.0),
        compare("cost_hazards", costs, r["costs"][:length, column], 0.0),
    ]


def check_point_dynamics(recording: Recording) -> list[Check]:
    """Check the agent alone under constant actions: single steps from recorded states, and
    means over 100 steps.
    """
    actions, qpos, qvel = (
        recording["point_actions"],
        recording["point_qpos"],
        recording["point_qvel"],
    )
    count, steps = len(actions), qpos.shape[1] - 1
    single = _agents_alone(count * steps, qpos[:, :-1].reshape(-1, 3), qvel[:, :-1].reshape(-1, 3))
    single.step(np.repeat(actions, steps, axis=0))
    ours = single.snapshot()["qpos"][:, :3].reshape(count, steps, 3)

    whole = _agents_alone(count, np.zeros((count, 3)), np.zeros((count, 3)))
    trajectory = [whole.snapshot()["qpos"][:, :3]]
    for _ in range(recording["point_traj"].shape[1] - 1):
        whole.step(actions)
        trajectory.append(whole.snapshot()["qpos"][:, :3])
    path, theirs = np.stack(trajectory, axis=1), recording["point_traj"][..., [0, 1, 3]]
    length, turned = path_means(path, Goal.env_seconds)
    their_length, their_turned = path_means(theirs, Goal.env_seconds)
    return [
        compare("point xy after one step", ours[..., :2], qpos[:, 1:, :2], XY),
        compare("point yaw after one step", ours[..., 2], qpos[:, 1:, 2], YAW),
        compare(
            "point mean speed / theirs",
            mean_ratio(length, their_length),
            np.ones(count),
            comparison.MEANS,
        ),
        compare(
            "point turn rate / theirs",
            mean_ratio(turned, their_turned),
            np.ones(count),
            comparison.MEANS,
        ),
    ]


def _forced(r: Recording) -> tuple[Goal, _Snapshot]:
    """A task with one row per recorded state, and the snapshot that puts every row into its
    state.
    """
    index = r["state_idx"].astype(np.intp)
    task = Goal(len(index), action_repeat=1, observe=("state",))
    task.reset([meta_of(r)["seed"]] * len(index))
    forced = task.snapshot()
    # Their slide joints lie along the start heading, ours along the world axes.
    turn = float(r["layout_agent_rot"])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    forced["qpos"][:, :2] = r["layout_agent_xy"] + r["state_qpos"][:, :2] @ rotation.T
    forced["qpos"][:, 2] = turn + r["state_qpos"][:, 2]
    forced["qvel"][:, :2] = r["state_qvel"][:, :2] @ rotation.T
    forced["qvel"][:, 2] = r["state_qvel"][:, 2]
    forced["bodies"][:, 0], forced["speeds"][:, 0] = r["state_vase_qpos"], r["state_vase_qvel"]
    forced["goal"][:] = r["goal_before"][index]
    return task, forced


def _agents_alone(rows: int, qpos: Floats, qvel: Floats) -> Goal:
    """Agents in the given states [rows, 3], with everything else far away."""
    task = Goal(rows, action_repeat=1, observe=())
    task.reset([0] * rows)
    forced = task.snapshot()
    forced["qpos"][:], forced["qvel"][:] = qpos, qvel
    forced["bodies"][..., :2] = 100.0
    task.restore(forced)
    return task
