"""Race and Formula One: rules of their episodes, and that leaving out distant walls and barrels
changes nothing.
"""

import numpy as np
import pytest
import torch

from wasp_cli.errors import TaskError
from wasp_cli.tasks import car
from wasp_cli.tasks.formula import track
from wasp_cli.tasks.formula.model import BARREL_RADIUS, clear_of_barriers
from wasp_cli.tasks.formula.task import Formula
from wasp_cli.tasks.frames import distance
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.motors import Motors
from wasp_cli.tasks.outline import distance_to_segments, inside
from wasp_cli.tasks.race.task import GOAL_XY, HAZARD_RADIUS, Race
from wasp_cli.tasks.registry import TASKS

VECTORS = ("state", "privileged")


def place(task, row: int, xy, heading: float) -> None:
    """Set a car down at rest; `heading` is the direction of its front."""
    state = task.snapshot()
    state["qpos"][row] = car.start_pose(np.array(xy), heading + np.pi / 2)
    state["qvel"][row] = 0.0
    task.restore(state)


def far_from_barrels(task: Formula) -> None:
    state = task.snapshot()
    state["bodies"][..., 0] += 500.0
    state["env_steps"][:] = 1
    task.restore(state)


def test_left_is_the_drivers_right_and_the_front_is_minus_y():
    task = Race(3, action_repeat=10, observe=())
    task.reset([0, 0, 0])
    for row in range(3):
        place(task, row, (6.0, 1.0), 0.0)
    task.step(np.array([[0.02, 0.02], [0.02, -0.02], [-0.02, -0.02]]))
    xy, heading, velocity = task.pose()
    assert xy[0, 0] > 6.02
    assert heading[1] > 0.05
    assert xy[2, 0] < 5.98
    assert velocity[0, 0] > 0.1
    assert abs(heading[0]) < 0.02  # it hops, and drifts by that


def test_the_goal_pays_ten_and_ends_the_race():
    task = Race(2, observe=())
    task.reset([0, 1])
    place(task, 0, (GOAL_XY[0] - 0.302, GOAL_XY[1]), 0.0)
    steps = [task.step(np.full((2, 2), 0.02)) for _ in range(3)]
    assert sum(step.goals[0] for step in steps) == 1
    assert sum(step.reward[0] for step in steps) == pytest.approx(10.0, abs=0.1)
    assert steps[-1].terminated.tolist() == [True, False]
    assert steps[-1].ended.tolist() == [True, False]
    assert sum(step.env_steps[0] for step in steps) < 12


def test_bushes_and_scenery_cost_apart_and_once_together():
    task = Race(3, action_repeat=1, observe=())
    task.reset([0, 0, 0])
    state = task.snapshot()
    state["hazards"][:] = 9.0
    state["hazards"][0, 3] = (0.0, 1.1)
    state["hazards"][2, 3] = (-1.0, 1.5)
    task.restore(state)
    place(task, 0, (HAZARD_RADIUS - 1e-3, 1.1), 0.0)
    place(task, 1, (HAZARD_RADIUS + 1e-3, 1.1), 0.0)
    # The side of a wheel overlaps the face of the fence by 2 mm.
    place(task, 2, (-1.0, np.interp(-1.0, [-1.69, -0.36], [1.6255, 1.64]) - 0.155 + 0.002), 0.0)
    step = task.step(np.zeros((3, 2)))
    assert step.sources["hazards"].tolist() == [1, 0, 1]
    assert step.sources["static_geoms_contact"].tolist() == [0, 0, 1]
    assert step.cost_env.tolist() == [1, 0, 1]


def test_leaving_out_distant_scenery_changes_no_motion(monkeypatch):
    quick, whole = Race(6, observe=()), Race(6, observe=())
    quick.reset(range(6))
    whole.reset(range(6))
    left_out = 0
    for t in range(40):
        action = np.random.default_rng(t).uniform(-0.02, 0.03, (6, 2))
        whole.restore(quick.snapshot())
        with monkeypatch.context() as patch:
            patch.setattr("wasp_cli.tasks.race.task.car.REACH", 99.0)
            whole._refresh(np.arange(6))
            whole.step(action)
        left_out += int((quick._walls == 0).sum())
        quick.step(action)
        np.testing.assert_allclose(quick.snapshot()["qpos"], whole.snapshot()["qpos"], atol=1e-9)
    assert left_out > 60


def test_stages_follow_each_other_around_the_lap():
    task = Formula(7, level=0, observe=())
    seeds, found = iter(range(200)), {}
    while len(found) < 7:
        seed = next(seeds)
        task.reset([seed] * 7)
        found.setdefault(int(task.snapshot()["stage"][0]), seed)
    task.reset([found[stage] for stage in range(7)])
    state = task.snapshot()
    for stage in range(7):
        start = track.STAGES[(stage - 1) % 7]
        assert distance(state["qpos"][stage, :2], start) < 1e-8
        assert state["goal"][stage].tolist() == track.STAGES[stage].tolist()
        place(task, stage, track.STAGES[stage] - (0.301, 0.0), 0.0)
    steps = [task.step(np.full((7, 2), 0.02)) for _ in range(3)]
    assert sum(step.goals for step in steps).tolist() == [1] * 7
    assert task.snapshot()["goal"].tolist() == np.roll(track.STAGES, -1, axis=0).tolist()
    assert not steps[-1].ended.any()
    # 10 for the stage and the way to it; the next goal's distance starts anew.
    assert all(9.5 < sum(step.reward for step in steps)[row] < 10.5 for row in range(7))


def test_a_barrel_costs_while_it_is_pushed_and_barely_slows_the_car():
    task, free = Formula(1, observe=()), Formula(1, level=0, observe=())
    for each in (task, free):
        each.reset([3])
    far_from_barrels(task)
    start, ahead = track.FINE_LAP[400, :2], track.ahead(np.array([400]), 1.0)[0]
    heading = np.arctan2(*(ahead - start)[::-1])
    for each in (task, free):
        place(each, 0, start, heading)
    state = task.snapshot()
    state["bodies"][0, 7] = [*(start + 0.6 * (ahead - start)), 0.0, 1.0, 0.0, 0.0, 0.0]
    task.restore(state)
    costs = []
    for _ in range(20):
        step = task.step(np.full((1, 2), 0.015))
        costs.append(int(step.sources["vases_contact"][0]))
        free.step(np.full((1, 2), 0.015))
    assert sum(costs[:2]) == 0
    assert sum(costs) > 5
    moved = task.snapshot()["bodies"][0, 7, :2] - state["bodies"][0, 7, :2]
    assert moved @ (ahead - start) > 0.1
    ways = [np.linalg.norm(each.pose()[0][0] - start) for each in (task, free)]
    assert ways[0] == pytest.approx(ways[1], rel=0.15)
    untouched = np.delete(np.arange(200), 7)
    assert (task.snapshot()["bodies"][0, untouched] == state["bodies"][0, untouched]).all()


@pytest.mark.parametrize("ring", ["OUTER_BARRIER", "INNER_BARRIER", "PIT_WALL"])
def test_every_barrier_stops_the_car_and_costs(ring):
    outline = getattr(track, ring)
    sides = np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)
    middles = sides.mean(axis=1)
    # Head-on from where the track is, against half a dozen sides.
    at = track.FINE_LAP[track.progress(middles), :2]
    chosen = np.flatnonzero(
        (distance(at, middles) > 0.6) & (np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1) > 0.5)
    )[::12][:6]
    task = Formula(len(chosen), observe=())
    task.reset([0] * len(chosen))
    far_from_barrels(task)
    for row, side in enumerate(chosen):
        towards = (middles[side] - at[side]) / distance(at[side], middles[side])
        start = middles[side] - 0.45 * towards
        place(task, row, start, np.arctan2(towards[1], towards[0]))
    starts_inside = [
        inside(task.pose()[0], getattr(track, name))
        for name in ("OUTER_BARRIER", "INNER_BARRIER", "PIT_WALL")
    ]
    touched = np.zeros(len(chosen), bool)
    for _ in range(25):
        touched |= task.step(np.full((len(chosen), 2), 0.02)).sources["static_geoms_contact"] > 0
    ends_inside = [
        inside(task.pose()[0], getattr(track, name))
        for name in ("OUTER_BARRIER", "INNER_BARRIER", "PIT_WALL")
    ]
    assert touched.all()
    for before, after in zip(starts_inside, ends_inside, strict=True):
        assert before.tolist() == after.tolist()


def test_a_part_of_the_barriers_acts_as_all_of_them(monkeypatch):
    part, whole = Formula(7, observe=()), Formula(7, observe=())
    part.reset(range(7))
    whole.reset(range(7))
    beside = 0
    for t in range(36):
        action = np.random.default_rng(t // 10).uniform(0.0, 0.02, (7, 2))
        if t % 6 and not (part._walls > 0).any():  # nothing is near: a sample will do
            part.step(action)
            continue
        whole.restore(part.snapshot())
        with monkeypatch.context() as patch:
            patch.setattr(
                "wasp_cli.tasks.formula.task.sectors", lambda xy: np.ones(len(xy), np.int64)
            )
            patch.setattr("wasp_cli.tasks.formula.task.car.REACH", 99.0)
            whole._refresh(np.arange(7))
            expected = whole.step(action)
        beside += int((part._walls > 0).sum())
        step = part.step(action)
        np.testing.assert_allclose(part.snapshot()["qpos"], whole.snapshot()["qpos"], atol=1e-7)
        assert (
            step.sources["static_geoms_contact"].tolist()
            == expected.sources["static_geoms_contact"].tolist()
        )
    assert beside > 10


def test_barrels_are_set_down_beside_barriers_and_others_stay():
    task = Formula(4, observe=())
    task.reset(range(4))
    for row in range(4):
        before = task.snapshot()["bodies"][row, :, :2]
        after = clear_of_barriers(before)
        moved = distance(before, after) > 0
        assert 5 < moved.sum() < 40
        gaps = distance_to_segments(after[moved], track.SIDES).min(axis=1)
        assert (gaps > BARREL_RADIUS).mean() > 0.9
        clear = distance_to_segments(before, track.SIDES).min(axis=1) > 0.4
        assert not moved[clear].any()
        assert distance(before, after).max() < 1.2
        assert (clear_of_barriers(after)[~moved] == after[~moved]).all()


@pytest.mark.parametrize(("make", "steps"), [(Race, 20), (Formula, 12)])
def test_a_row_does_not_depend_on_the_others_nor_on_threads(make, steps):
    seeds = [5, 6, 7]
    plan = np.random.default_rng(0).uniform(-0.01, 0.03, (steps, 3, 2))
    together, threaded = make(3, observe=VECTORS), make(3, observe=VECTORS, threads=2)
    together.reset(seeds)
    threaded.reset(seeds)
    alone = [make(1, observe=VECTORS) for _ in seeds]
    for task, seed in zip(alone, seeds, strict=True):
        task.reset([seed])
    for action in plan:
        step, other = together.step(action), threaded.step(action)
        assert step.observation.state.tobytes() == other.observation.state.tobytes()
        for row, task in enumerate(alone):
            own = task.step(action[row : row + 1])
            assert step.observation.state[row].tobytes() == own.observation.state[0].tobytes()
            assert (
                step.observation.privileged[row].tobytes()
                == own.observation.privileged[0].tobytes()
            )
            assert (step.reward[row], step.cost_env[row]) == (own.reward[0], own.cost_env[0])


def test_unstable_physics_is_an_error_not_a_new_start():
    task = Race(2, observe=())
    task.reset([0, 1])
    state = task.snapshot()
    state["qvel"][1, :3] = 1e11
    task.restore(state)
    with pytest.raises(TaskError, match="row 1 became unstable"):
        task.step(np.zeros((2, 2)))


# Which commands are one and the same force: held against the physics, and the projection against
# every action of a grid.


@pytest.mark.parametrize("task", ["race1", "formula1", "goal1"])
def test_actions_of_the_same_force_move_the_robot_alike_and_others_do_not(task):
    motors = TASKS[task].motors
    assert motors.saturation is not None
    random = np.random.default_rng(3)
    wanted, command = (
        torch.from_numpy(random.uniform(-1, 1, (16, 2)).astype(np.float32)) for _ in range(2)
    )
    wanted[8:] *= 0.01
    least = motors.least(command, wanted)
    assert not torch.equal(least, wanted)
    world = make_task(task, 16, action_repeat=2, observe=("privileged",), threads=1)
    after = []
    for action in (wanted, least, command):
        world.reset(range(16))
        after.append([world.step(action.numpy()).observation.privileged for _ in range(3)][-1])
    assert np.array_equal(after[0], after[1])
    differs = (np.abs(motors.force(wanted.numpy()) - motors.force(command.numpy())) > 0.1).any(1)
    assert differs.sum() > 8
    assert (np.abs(after[0] - after[2])[differs].max(1) > 1e-4).all()


def test_the_least_correction_is_the_closest_action_of_the_same_force():
    motors = Motors((0.3, 1.0))
    line = np.linspace(-1, 1, 41).round(2)
    every = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    random = np.random.default_rng(1)
    for command, wanted in random.choice(every, (200, 2)):
        least = motors.least(torch.tensor(command), torch.tensor(wanted)).numpy()
        assert np.allclose(motors.force(least), motors.force(wanted), atol=1e-5)
        alike = every[(np.abs(motors.force(every) - motors.force(wanted)) < 1e-6).all(1)]
        assert (
            np.linalg.norm(least - command) <= np.linalg.norm(alike - command, axis=1).min() + 1e-5
        )


def test_where_no_motor_is_known_an_action_is_its_own_force():
    action = np.array([[0.3, -1.0]])
    assert Motors().force(action) is action
    wanted = torch.tensor([[0.5, 0.5]])
    assert Motors().least(torch.zeros(1, 2), wanted) is wanted
    assert TASKS["somebody/Else-v0"].motors == Motors()
