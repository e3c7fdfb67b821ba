"""Recordings of the car tasks, held against ours. T = steps of the recording, S = recorded states.

What a recording cannot tell is left out, and what our outlines of walls cannot decide is measured
as a distance:

* Motion is compared one env step at a time from recorded states ("teacher-forced"). Beside walls,
  the outlines' accuracy is the tolerance. Barrels were not recorded with the states: steps near
  barrels are compared by how far the car was led astray.
* Whether a wall is touched is compared as a gap: where the recorded car touched, ours is at most
  the accuracy away; where it did not, ours overlaps by no more than that.
* Episode rules are compared on a car that is set down at rest at each recorded place.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import mujoco
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
from wasp_cli.tasks import car
from wasp_cli.tasks.base import Bools, Floats
from wasp_cli.tasks.frames import distance, quaternion_rotation, wrapped, yaw_quaternion
from wasp_cli.tasks.navigation import PHYSICS_STEPS, Navigation
from wasp_cli.tasks.outline import distance_to_segments
from wasp_cli.tasks.physics import BatchPhysics, ModelBuilder

XY, YAW = 1e-6, 5e-6  # m, rad after one env step without contact
# m; a barrel weighs 14 mg, but where it was is not recorded: one may be missing, or be too many
BESIDE_BARREL = 1e-2
PUSHED_OUT, GAP = 2.5, 1.5
"""Tolerances beside walls, in accuracies of their outlines: a car that overlaps is pushed out
by up to twice the overlap in a step.
"""
FRAME = 25  # env steps between two recorded sets of barrels
# env steps: 3 of them are 0.1 m of way, of which the corners of a barrel account for some
BARREL_CONTACT = 5
BARREL_LIDAR = 5e-3  # recorded barrels were rounded to 1 mm

_STANDING_Z = 0.0999


class Maker(Protocol):
    """The class of a car task."""

    def __call__(
        self, batch: int, *, action_repeat: int, observe: tuple[str, ...]
    ) -> Navigation: ...


class CarTask(NamedTuple):
    """What a check needs to know of a task."""

    prefix: str  # of the recordings of the car alone under the task's integrator
    worst: float  # tolerance in m of the worst step without walls and barrels

    make: Maker
    build_model: ModelBuilder
    sides: Floats  # [V, 2, 2] of all walls
    accuracy: float  # of these sides in m
    hazard_radius: float | None = None  # m


def check_car_episode(r: Recording, task: CarTask) -> list[Check]:
    """Check layout, motion, reward, observations, contacts and episode rules of one recorded
    episode.
    """
    parts = (_numbers, _layout, _motion, _observations, _walls, _barrels, _rules)
    return [check for part in parts for check in part(r, task)]


def _numbers(r: Recording, task: CarTask) -> list[Check]:
    return check_numbers(
        r,
        task.make(1, action_repeat=1, observe=()),
        task.build_model(0, 0, True),
        task.hazard_radius,
    )


def _layout(r: Recording, task: CarTask) -> list[Check]:
    ours = task.make(1, action_repeat=1, observe=())
    ours.reset([meta_of(r)["seed"]])
    start = ours.snapshot()
    rotation = quaternion_rotation(start["qpos"][0, 3:7])
    yaw = wrapped(np.arctan2(rotation[1, 0], rotation[0, 0]) - r["layout_agent_rot"])
    checks = [
        compare("layout agent_xy", start["qpos"][0, :2], r["layout_agent_xy"], 0.0),
        compare("layout agent_rot", yaw, 0.0, comparison.ANGLE),
        compare("layout goal_xy", start["goal"][0], r["layout_goal_xy"], comparison.RECORDED),
    ]
    if r["layout_hazards_xy"].size:
        checks.append(
            compare("layout hazards_xy", start["hazards"][0], r["layout_hazards_xy"], 0.0)
        )
    if r["layout_vases_xy"].size:
        barrels = start["bodies"][0]
        turned = quaternion_rotation(barrels[:, 3:])
        apart = wrapped(np.arctan2(turned[:, 1, 0], turned[:, 0, 0]) - r["layout_vases_yaw"])
        checks += [
            compare("layout vases_xy", barrels[:, :2], r["layout_vases_xy"], 0.0),
            compare("layout vases_yaw", apart, np.zeros_like(apart), comparison.ANGLE),
        ]
    return checks


def _forced(
    r: Recording, task: CarTask, rows: NDArray[np.intp]
) -> tuple[Navigation, dict[str, NDArray[Any]]]:
    """A task with one row for each of these recorded states, and the snapshot that puts every
    row into its state.
    """
    index = r["state_idx"].astype(np.intp)[rows]
    ours = task.make(len(rows), action_repeat=1, observe=("state",))
    ours.reset([meta_of(r)["seed"]] * len(rows))
    # A first step lets a world settle whatever it settles at the start.
    ours.step(np.zeros((len(rows), 2)))
    forced = ours.snapshot()
    forced["qpos"][:], forced["qvel"][:] = r["state_qpos"][rows], r["state_qvel"][rows]
    forced["goal"][:] = r["goal_before"][index]
    return ours, forced


def _motion(r: Recording, task: CarTask) -> list[Check]:
    index = r["state_idx"].astype(np.intp)
    if not index.size:
        return []
    ours, forced = _forced(r, task, np.arange(len(index)))
    ours.restore(forced)
    step = ours.step(r["action"][index])
    rotation = quaternion_rotation(ours.snapshot()["qpos"][:, 3:7])
    astray = distance(ours.snapshot()["qpos"][:, :2], r["xy"][index])
    turned = wrapped(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]) - r["yaw"][index])
    off = np.abs(step.reward - r["reward"][index])

    walls = (
        distance_to_segments(forced["qpos"][:, :2], task.sides).min(axis=1)
        < car.REACH + task.accuracy
    )
    barrels = ~walls & _near_barrels(r, forced, index)
    free = ~walls & ~barrels
    looser = task.worst / XY
    checks = _free("xy after one step, free", astray[free], XY, looser)
    checks += _free("yaw after one step, free", np.abs(turned[free]), YAW, looser)
    checks += _free("reward, free", off[free], comparison.REWARD, looser)
    checks += errors(("xy after one step, by barrels", astray, barrels, BESIDE_BARREL))
    return checks + errors(
        ("xy after one step, by walls", astray, walls, PUSHED_OUT * task.accuracy),
        ("reward, by walls", off, walls, PUSHED_OUT * task.accuracy),
    )


def _free(name: str, found: Floats, tolerance: float, looser: float) -> list[Check]:
    """Nine of ten errors within the tolerance, and the worst one, where a wheel's contact with
    the floor began or ended within a step.
    """
    if not found.size:
        return []
    checks = (
        [compare(f"{name}, 9 of 10", np.quantile(found, 0.9), 0.0, tolerance)]
        if looser > 1.0
        else []
    )
    return [*checks, compare(name, found, np.zeros(len(found)), tolerance * looser)]


def _near_barrels(
    r: Recording, forced: Mapping[str, NDArray[Any]], index: NDArray[np.intp]
) -> Bools:
    """Steps whose barrels nobody recorded: some barrel is, or was once, within reach."""
    if not forced["bodies"].shape[1]:
        return np.zeros(len(index), np.bool_)
    near = (
        distance(forced["bodies"][:, :, :2], forced["qpos"][:, None, :2]) < car.REACH + 0.5
    ).any(axis=1)
    touched = np.array(
        [r["n_vase_contacts"][max(0, t - FRAME) : t + 1].any() for t in index.tolist()]
    )
    return np.asarray(near | touched)


def _observations(r: Recording, task: CarTask) -> list[Check]:
    # An observation after action t belongs to the state before action t + 1, where that was
    # recorded too.
    index, seen = r["state_idx"].astype(np.intp), r["obs_idx"].astype(np.intp)
    which = np.flatnonzero(np.isin(seen + 1, index))
    before = seen[which]
    if not which.size:
        return []
    ours, forced = _forced(r, task, np.searchsorted(index, before + 1))
    forced["goal"][:] = r["goal_after"][before]
    forced["control"][:] = np.clip(r["action"][before].astype(np.float64), -1.0, 1.0)
    walls = (
        distance_to_segments(forced["qpos"][:, :2], task.sides).min(axis=1)
        < car.REACH + task.accuracy
    )
    free = ~walls & ~_near_barrels(r, forced, before)
    known = np.zeros(len(before), np.bool_)
    if "vases_xy_mm" in r and forced["bodies"].shape[1]:
        frames = before // FRAME
        known = (before % FRAME == 0) & (frames < len(r["vases_xy_mm"]))
        forced["bodies"][known, :, :2] = r["vases_xy_mm"][frames[known]] / 1000.0
    state = ours.restore(forced).state
    checks: list[Check] = []
    start, theirs, meta = 0, r["obs"][which], meta_of(r)
    for name, size in zip(meta["obs_keys"], meta["obs_dims"], strict=True):
        error = np.abs(state - theirs)[:, start : start + size].max(axis=1)
        start += size
        if name == "vases_lidar":
            checks += errors((name, error, known, BARREL_LIDAR))
        elif name.endswith("lidar"):
            checks += errors((name, error, np.ones(len(error), np.bool_), comparison.LIDAR))
        else:
            # Beside walls and barrels the accelerations are those of other contacts.
            checks += errors(
                (
                    name,
                    error,
                    free if name == "accelerometer" else np.ones(len(error), np.bool_),
                    comparison.SENSORS,
                )
            )
    return checks


def _walls(r: Recording, task: CarTask) -> list[Check]:
    index = r["state_idx"].astype(np.intp)
    rows = np.flatnonzero(index > 0)
    near = (
        distance_to_segments(r["state_qpos"][rows, :2], task.sides).min(axis=1)
        < car.REACH + task.accuracy
    )
    touching = r["n_static_contacts"][index[rows] - 1] > 0
    looked = rows[near | touching]
    if not looked.size:
        return []
    gaps, touching = wall_gaps(task.build_model, r["state_qpos"][looked]), touching[near | touching]
    checks = errors(
        ("gap to a wall that is touched", np.maximum(gaps, 0.0), touching, GAP * task.accuracy),
        ("overlap with one that is not", np.maximum(-gaps, 0.0), ~touching, GAP * task.accuracy),
    )
    # What the task itself makes of these states, in which our walls are touched or clearly not.
    ours, forced = _forced(r, task, looked)
    ours.restore(forced)
    costs, clear = ours.costs()["static_geoms_contact"], np.abs(gaps) > 1e-5
    return checks + errors(
        ("cost of walls as the gaps tell", (costs != (gaps < 0.0)).astype(float), clear, 0.0)
    )


def wall_gaps(build_model: ModelBuilder, qpos: Floats) -> Floats:
    """Measure the least signed distance [n] in m between the car in states [n, 13] and any
    wall; at most 0.5.
    """
    model = build_model(0, 1, False)
    data = mujoco.MjData(model)
    roots, car_root = model.body_rootid[model.geom_bodyid], model.body("agent").id
    own, walls = (
        np.flatnonzero(roots == car_root),
        np.flatnonzero((roots != car_root) & (model.geom_bodyid != 0)),
    )
    gaps = np.full(len(qpos), 0.5)
    for i, pose in enumerate(qpos):
        data.qpos[: car.NQ] = pose
        mujoco.mj_kinematics(model, data)
        apart = distance(data.geom_xpos[walls, :2], pose[:2]) - model.geom_rbound[walls]
        for wall in walls[apart < car.REACH + 0.5].tolist():
            for geom in own.tolist():
                gaps[i] = min(gaps[i], mujoco.mj_geomDistance(model, data, geom, wall, 0.5, None))
    return gaps


def _barrels(r: Recording, task: CarTask) -> list[Check]:
    """When the car first meets a barrel, led along its recorded path among barrels that ours
    push and the recording corrects.
    """
    touching = np.flatnonzero(r["n_vase_contacts"])
    if not touching.size:
        return []
    ours = task.make(1, action_repeat=1, observe=())
    ours.reset([meta_of(r)["seed"]])
    ours.step(r["action"][:1])
    first = len(r["xy"])
    for t in range(1, len(r["xy"])):
        forced = ours.snapshot()
        if "vases_xy_mm" in r and (t - 1) % FRAME == 0:
            forced["bodies"][0, :, :2] = r["vases_xy_mm"][(t - 1) // FRAME] / 1000.0
        forced["qpos"][0, :2], forced["qpos"][0, 2], forced["qpos"][0, 3:7] = (
            r["xy"][t - 1],
            r["z"][t - 1],
            yaw_quaternion(r["yaw"][t - 1]),
        )
        forced["qvel"][0, :3], forced["qvel"][0, 3:6] = r["vel"][t - 1], r["omega"][t - 1]
        forced["env_steps"][:] = t
        ours.restore(forced)
        if ours.step(r["action"][t : t + 1]).sources["vases_contact"][0]:
            first = t
            break
    return [compare("first contact with a barrel", first, touching[0], BARREL_CONTACT)]


def _rules(r: Recording, task: CarTask) -> list[Check]:
    """Goals, their moves, ends, and the costs that depend on places alone."""
    ours = task.make(1, action_repeat=1, observe=())
    ours.reset([meta_of(r)["seed"]])
    steps, goals = [], []
    for t in range(len(r["xy"])):
        forced = ours.snapshot()
        forced["qpos"][0, :2], forced["qpos"][0, 2] = r["xy"][t], _STANDING_Z
        forced["qpos"][0, 3:7] = yaw_quaternion(r["yaw"][t])
        forced["qvel"][:] = 0.0
        forced["env_steps"][:] = t
        if "bodies" in forced:
            forced["bodies"][..., 0] += 1000.0 * (forced["bodies"][..., 0] < 500.0)
        ours.restore(forced)
        step = ours.step(np.zeros((1, 2)))
        steps.append(step)
        goals.append(ours.snapshot()["goal"][0])
        if step.ended[0]:
            break
    checks = check_ends(r, steps, goals)
    keys = meta_of(r)["cost_keys"]
    if "cost_hazards" in keys:
        hazards = [step.sources.get("hazards", np.zeros(1))[0] for step in steps]
        checks.append(
            compare(
                "cost_hazards", hazards, r["costs"][: len(steps), keys.index("cost_hazards")], 0.0
            )
        )
    return checks


def check_car_dynamics(r: Recording, task: CarTask) -> list[Check]:
    """Check the car alone under constant actions: single steps from recorded states, and means
    over 100 steps.
    """
    prefix = task.prefix
    actions, qpos, qvel = r[f"{prefix}_actions"], r[f"{prefix}_qpos"], r[f"{prefix}_qvel"]
    physics = BatchPhysics(task.build_model(0, 0, True))
    count, steps = len(actions), qpos.shape[1] - 1
    single, _ = physics.advance(
        qpos[:, :-1].reshape(-1, car.NQ),
        qvel[:, :-1].reshape(-1, car.NV),
        np.repeat(actions, steps, axis=0),
        PHYSICS_STEPS,
    )
    state = np.tile(car.start_pose(np.zeros(2), 0.0), (count, 1)), np.zeros((count, car.NV))
    path = [_planar(state[0])]
    for _ in range(r[f"{prefix}_traj"].shape[1] - 1):
        state = physics.advance(*state, actions, PHYSICS_STEPS)
        path.append(_planar(state[0]))
    seconds = car.TIMESTEP * PHYSICS_STEPS
    speed, turn = path_means(np.stack(path, axis=1), seconds)
    their_speed, their_turn = path_means(r[f"{prefix}_traj"][..., [0, 1, 3]], seconds)
    ones = np.ones(count)
    return [
        *_free(
            f"{prefix} xy after one step",
            distance(single[:, :2], qpos[:, 1:, :2].reshape(-1, 2)),
            XY,
            task.worst / XY,
        ),
        compare(
            f"{prefix} mean speed / theirs", mean_ratio(speed, their_speed), ones, comparison.MEANS
        ),
        compare(
            f"{prefix} turn rate / theirs", mean_ratio(turn, their_turn), ones, comparison.MEANS
        ),
    ]


def _planar(qpos: Floats) -> Floats:
    """x, y, yaw [n, 3] of cars in states [n, 13]."""
    rotation = quaternion_rotation(qpos[:, 3:7])
    return np.stack(
        [qpos[:, 0], qpos[:, 1], np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])], axis=1
    )
