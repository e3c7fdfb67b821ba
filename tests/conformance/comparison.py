"""How a quantity is compared with a recording of the reference package."""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from mujoco import MjModel
from numpy.typing import NDArray

from wasp_cli.tasks.base import Bools, Floats, Step
from wasp_cli.tasks.frames import distance, wrapped
from wasp_cli.tasks.navigation import PHYSICS_STEPS, Navigation

Recording = Mapping[str, NDArray[Any]]
REWARD, SENSORS, LIDAR = 2e-6, 1e-5, 2e-5
ANGLE = 1e-12
RECORDED = 1e-9  # recorded goals were rounded to 9 decimals
MEANS = 0.05  # relative tolerance of mean speeds and turn rates over 100 env steps


class Check(NamedTuple):
    """One compared quantity."""

    quantity: str
    worst: float  # largest absolute error (nan when there is nothing finite to compare)
    tolerance: float
    compared: int  # number of entries compared

    @property
    def ok(self) -> bool:
        return self.compared > 0 and self.worst <= self.tolerance


def compare(quantity: str, ours: Any, theirs: Any, tolerance: float) -> Check:
    """Find the worst absolute difference of two arrays of one shape (any)."""
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    if ours.shape != theirs.shape:
        raise ValueError(f"{quantity}: shapes {ours.shape} and {theirs.shape} differ")
    return Check(
        quantity,
        float(np.abs(ours - theirs).max()) if ours.size else float("nan"),
        tolerance,
        ours.size,
    )


def errors(*parts: tuple[str, Floats, Bools, float]) -> list[Check]:
    """Check errors [n] against 0 on the chosen entries [n]; what was not recorded is no check."""
    return [
        compare(name, error[on], np.zeros_like(error[on]), tolerance)
        for name, error, on, tolerance in parts
        if on.any()
    ]


def meta_of(recording: Recording) -> dict[str, Any]:
    """Return what a recording states of its task."""
    meta: dict[str, Any] = json.loads(str(recording["meta"]))
    return meta


def check_numbers(
    recording: Recording, task: Navigation, model: MjModel, hazard_radius: float | None
) -> list[Check]:
    """Check the numbers that a recording states of its task, and every recorded reward."""
    meta, option = meta_of(recording), model.opt
    expected = {
        "timestep": option.timestep,
        "integrator": option.integrator,
        "frameskip": PHYSICS_STEPS,
        "hazard_size": hazard_radius,
    }
    expected |= {"num_steps": task.num_steps, "goal_size": task.goal_radius}
    known = {
        name: ours
        for name, ours in expected.items()
        if ours is not None and meta.get(name) is not None
    }
    checks = [compare(f"meta {name}", ours, meta[name], 1e-9) for name, ours in known.items()]
    theirs = [key.removeprefix("cost_") for key in meta["cost_keys"] if key != "cost_sum"]
    return [
        *checks,
        compare("meta cost_keys", sorted(task.cost_sources) != sorted(theirs), 0.0, 0.0),
        compare("meta obs_dims", task.state_size, sum(meta["obs_dims"]), 0.0),
        _rewards(recording, task.reward_goal, task.reward_clip),
    ]


def check_ends(recording: Recording, steps: Sequence[Step], goals: Sequence[Floats]) -> list[Check]:
    """Check when the steps of an episode met goals, where these were afterwards, and how it
    ended.
    """
    length = len(steps)
    return [
        compare("length of the episode", length, len(recording["xy"]), 0.0),
        compare(
            "goal met, all steps",
            [step.goals[0] for step in steps],
            recording["goal_met"][:length],
            0.0,
        ),
        compare("goal, all steps", goals, recording["goal_after"][:length], RECORDED),
        compare(
            "terminated",
            [step.terminated[0] for step in steps],
            recording["terminated"][:length],
            0.0,
        ),
        compare(
            "truncated",
            [step.ended[0] and not step.terminated[0] for step in steps],
            recording["truncated"][:length],
            0.0,
        ),
    ]


def _rewards(recording: Recording, reward_goal: float, reward_clip: float) -> Check:
    """Check every recorded reward against the recorded way and our bonus."""
    xy = np.concatenate([recording["layout_agent_xy"][None], recording["xy"]])
    before, after = (
        distance(xy[:-1], recording["goal_before"]),
        distance(xy[1:], recording["goal_before"]),
    )
    rewards = np.clip(
        before - after + reward_goal * recording["goal_met"], -reward_clip, reward_clip
    )
    return compare("reward, all steps", rewards, recording["reward"], REWARD)


def path_means(path: Floats, seconds: float) -> tuple[Floats, Floats]:
    """Return mean speed [A] in m/s and mean turn rate [A] in rad/s along x, y, yaw [A, T, 3]
    (m, rad), in rows `seconds` apart.
    """
    moves = np.diff(path, axis=1)
    speed: Floats = np.hypot(moves[..., 0], moves[..., 1]).mean(axis=1) / seconds
    return speed, wrapped(moves[..., 2]).mean(axis=1) / seconds


def mean_ratio(ours: Floats, theirs: Floats) -> Floats:
    """Return ours / theirs [A]; next to standstill (0.02 of a unit) the absolute difference
    counts.
    """
    return 1.0 + (ours - theirs) / np.maximum(np.abs(theirs), 0.02)
