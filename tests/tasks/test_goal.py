"""Goal: rules of an episode, and independence of rows, threads and repeats, bit for bit."""

import numpy as np
import pytest

from tests.tasks.test_gym import text
from wasp_cli.tasks.camera.topdown import from_above
from wasp_cli.tasks.goal.task import AGENT_KEEPOUT, GOAL_KEEPOUT, HAZARD_KEEPOUT, Goal
from wasp_cli.tasks.goal.two import TwoGoals
from wasp_cli.tasks.make import make_task

VECTORS = ("state", "privileged")


def actions(steps: int, batch: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, batch, 2))


def row_of(result, row: int):
    """One row of such a result, kept as a batch of one."""
    if isinstance(result, dict):
        return {name: row_of(value, row) for name, value in result.items()}
    if isinstance(result, tuple):
        return tuple(row_of(value, row) for value in result)
    return None if result is None else result[row : row + 1]


def before_the_goal(task: Goal, goal: str = "goal", clearance: float = 0.302) -> None:
    """Put every agent in front of a goal, at rest and facing it, away from the vase."""
    state = task.snapshot()
    state["qpos"][:, :2] = state[goal] - [clearance, 0.0]
    state["qpos"][:, 2] = 0.0
    state["bodies"][..., :2] = 5.0
    state["qvel"][:] = 0.0
    task.restore(state)


def beside_the_vase(task: Goal) -> None:
    state = task.snapshot()
    heading = np.stack([np.cos(state["qpos"][:, 2]), np.sin(state["qpos"][:, 2])], axis=1)
    state["bodies"][:, 0, :2] = state["qpos"][:, :2] + 0.3 * heading
    task.restore(state)


def test_a_row_does_not_depend_on_the_others():
    seeds, plan = [5, 6, 7, 8], actions(40, 4)
    plan[:20] = [1.0, 0.0]
    together = Goal(4, observe=("pixels", *VECTORS))
    together.reset(seeds)
    beside_the_vase(together)
    alone = [Goal(1, observe=("pixels", *VECTORS)) for _ in seeds]
    for row, task in enumerate(alone):
        task.reset([seeds[row]])
        beside_the_vase(task)
    for action in plan:
        step = together.step(action)
        for row, task in enumerate(alone):
            assert text(row_of(step, row)) == text(task.step(action[row : row + 1]))


def test_decision_steps_only_cut_the_time():
    plan = actions(30, 3)
    coarse, fine = (
        Goal(3, action_repeat=4, observe=VECTORS),
        Goal(3, action_repeat=1, observe=VECTORS),
    )
    for task in (coarse, fine):
        task.reset([1, 2, 3])
        before_the_goal(task)
    for action in plan:
        whole, parts = coarse.step(action), [fine.step(action) for _ in range(4)]
        assert text(whole.observation.state) == text(parts[-1].observation.state)
        assert whole.cost_env.tolist() == sum(part.cost_env for part in parts).tolist()
        assert whole.goals.tolist() == sum(part.goals for part in parts).tolist()
        np.testing.assert_allclose(whole.reward, sum(part.reward for part in parts), atol=1e-12)


@pytest.mark.parametrize("level", [1, 2])
def test_leaving_out_vases_at_rest_changes_no_motion(level, monkeypatch):
    quick, whole = Goal(8, level=level, observe=()), Goal(8, level=level, observe=())
    quick.reset(range(8))
    whole.reset(range(8))
    left_out = 0
    for action in actions(50, 8):
        with monkeypatch.context() as patch:
            patch.setattr("wasp_cli.tasks.goal.task._REACH", np.inf)
            whole.restore(quick.snapshot())
            whole.step(action)
        left_out += int((~quick._active).sum())
        quick.step(action)
        ours, theirs = quick.snapshot(), whole.snapshot()
        np.testing.assert_allclose(ours["qpos"], theirs["qpos"], atol=1e-9)
        np.testing.assert_allclose(ours["bodies"][..., :3], theirs["bodies"][..., :3], atol=1e-7)
    assert left_out > 250
    assert np.median(ours["bodies"][..., 2]) == pytest.approx(0.0999564, abs=1e-6)


def test_a_reached_goal_pays_and_moves_to_a_free_place():
    task = Goal(6, observe=())
    task.reset(range(6))
    before_the_goal(task)
    old = task.snapshot()["goal"]
    step = task.step(np.tile([1.0, 0.0], (6, 1)))
    state = task.snapshot()
    assert step.goals.tolist() == [1] * 6
    assert (step.reward > 0.9).all()
    assert (np.abs(state["goal"] - old).max(axis=1) > 0).all()
    gaps = np.linalg.norm(state["goal"][:, None] - state["hazards"], axis=2)
    assert (gaps >= GOAL_KEEPOUT + HAZARD_KEEPOUT).all()
    assert not step.ended.any()


def test_where_a_later_goal_lies_depends_on_when_the_last_one_was_reached():
    """As in the original, and as docs/tasks.md says: every env step draws from the stream of
    the world.
    """
    places = []
    for waited in (0, 1):
        task = Goal(2, observe=())
        task.reset([7, 8])
        for _ in range(waited):
            task.step(np.zeros((2, 2)))
        before_the_goal(task)
        assert task.step(np.tile([1.0, 0.0], (2, 1))).goals.tolist() == [1, 1]
        places.append(task.snapshot()["goal"])
    assert (np.abs(places[0] - places[1]).max(axis=1) > 0.01).all()


def test_a_snapshot_carries_goals_to_come():
    task = Goal(3, observe=VECTORS)
    task.reset([3, 4, 5])
    for action in actions(7, 3):
        task.step(action)
    before_the_goal(task)
    kept = task.snapshot()

    def future(task: Goal) -> list:
        out = [task.restore(kept)]
        for action in actions(5, 3, seed=1):
            action[:, 0] = 1.0
            out.append(task.step(action))
        before_the_goal(task)
        return [*out, *(task.step(np.tile([1.0, 0.0], (3, 1))) for _ in range(3)), task.snapshot()]

    first = future(task)
    other = Goal(3, observe=VECTORS)
    other.reset([9, 9, 9])
    assert sum(int(step.goals.sum()) for step in first[1:-1]) >= 4
    for ours, theirs, fresh in zip(first, future(task), future(other), strict=True):
        assert text(ours) == text(theirs) == text(fresh)


def test_an_env_step_costs_within_a_hazard_and_only_there():
    task = Goal(2, action_repeat=3, observe=())
    task.reset([0, 1])
    state = task.snapshot()
    state["qpos"][:, :2] = state["hazards"][:, 2] + np.array([[0.199, 0.0], [0.0, 0.201]])
    state["hazards"][:, [0, 1, 3, 4, 5, 6, 7]] = 9.0
    state["goal"][:], state["bodies"][..., :2] = -9.0, 5.0
    task.restore(state)
    step = task.step(np.zeros((2, 2)))
    assert step.cost_env.tolist() == [3, 0]
    assert step.cost.tolist() == [True, False]
    assert step.sources["hazards"].tolist() == [3, 0]


def test_the_time_limit_cuts_a_decision_step_short():
    task = Goal(2, action_repeat=4, observe=("privileged",))
    task.reset([0, 1])
    state = task.snapshot()
    state["env_steps"][:] = [Goal.num_steps - 2, 0]
    task.restore(state)
    step = task.step(np.ones((2, 2)))
    assert step.env_steps.tolist() == [2, 4]
    assert step.ended.tolist() == [True, False]
    assert not step.terminated.any()


def test_an_impossible_goal_terminates(monkeypatch):
    monkeypatch.setattr("wasp_cli.tasks.goal.task.draw_goal", lambda *_: None)
    task = Goal(1, observe=())
    task.reset([0])
    before_the_goal(task)
    step = task.step(np.array([[1.0, 0.0]]))
    assert step.terminated.tolist() == [True]
    assert step.ended.tolist() == [True]


def test_the_privileged_vector_is_scaled_and_faces_the_goal():
    task = Goal(64, observe=("privileged",))
    task.reset(range(64))
    before_the_goal(task, clearance=1.0)
    seen = task.restore(task.snapshot()).privileged
    np.testing.assert_allclose(
        seen[:, 3:7], np.tile([1.0, 0.0, 1 / 3, np.exp(-1.0)], (64, 1)), atol=1e-6
    )
    drives = np.concatenate(
        [task.step(action).observation.privileged for action in actions(60, 64)]
    )
    assert np.abs(drives).max() <= 3.0
    assert drives.std(axis=0).max() < 2.0
    assert np.abs(drives[:, 2]).max() > 0.1


def test_pushing_a_vase_costs_at_level_2_only():
    for level, expected in ((1, 0), (2, 1)):
        task = Goal(1, level=level, action_repeat=10, observe=())
        task.reset([0])
        state = task.snapshot()
        state["hazards"][:] = 9.0
        state["bodies"][..., :2] = 5.0 + np.arange(state["bodies"].shape[1])[:, None]
        state["goal"][:] = -9.0
        task.restore(state)
        task.step(np.zeros((1, 2)))  # the vases come to rest where they are
        beside_the_vase(task)
        step = task.step(np.array([[1.0, 0.0]]))
        assert (step.cost_env[0] > 0) == expected
        assert [name for name, count in step.sources.items() if count[0]] == [
            "vases_contact",
            "vases_velocity",
        ] * expected


# Two goals of equal look: nothing that an assistant may see tells them apart, and only one of them
# counts.


BATCH = 6


def begun(
    observe: tuple[str, ...] = ("pixels", "state", "privileged"), batch: int = BATCH
) -> TwoGoals:
    task = make_task("goal1-two", batch, observe=observe)
    assert isinstance(task, TwoGoals)
    task.reset(range(batch))
    return task


def exchange(task: TwoGoals) -> None:
    """The other goal becomes the operator's."""
    state = task.snapshot()
    state["goal"], state["other"] = state["other"], state["goal"]
    task.restore(state)


def test_cameras_and_lidar_do_not_tell_whose_goal_is_whose():
    task = begun()
    for _ in range(20):  # seen from several places
        task.step(np.random.default_rng(0).uniform(-1, 1, (BATCH, 2)))
        seen, above = task.restore(task.snapshot()), from_above(task, 0)
        exchange(task)
        other = task.restore(task.snapshot())
        assert seen.pixels.tobytes() == other.pixels.tobytes()
        assert seen.state.tobytes() == other.state.tobytes()
        assert (seen.privileged != other.privileged).any(axis=1).all(), "who is privileged knows"
        assert (from_above(task, 0) != above).any(), "and so do people who look at a map"


def test_only_the_operators_goal_is_rewarded():
    task = begun(())
    forward = np.tile([1.0, 0.0], (BATCH, 1))
    before_the_goal(task, "other")
    before = task.snapshot()
    away = np.linalg.norm(before["goal"] - before["qpos"][:, :2], axis=1)
    step = task.step(forward)
    after = task.snapshot()
    assert (
        np.linalg.norm(after["other"] - after["qpos"][:, :2], axis=1) < task.goal_radius
    ).all(), "the other one is reached"
    np.testing.assert_allclose(
        step.reward, away - np.linalg.norm(after["goal"] - after["qpos"][:, :2], axis=1), atol=1e-12
    )
    assert (step.goals == 0).all()
    assert (task.tallies()["wrong_goals"] == 1).all()
    np.testing.assert_array_equal(after["other"], before["other"])
    task.step(forward)
    assert (task.tallies()["wrong_goals"] == 1).all(), "staying there is no second visit"

    before_the_goal(task)
    before, step = task.snapshot(), task.step(forward)
    assert (step.goals == 1).all()
    assert (step.reward > 0.9).all()
    after = task.snapshot()
    assert (after["goal"] != before["goal"]).any(axis=1).all()
    assert (after["other"] != before["other"]).any(axis=1).all()
    task.reset([9], np.arange(BATCH) == 2)
    assert task.tallies()["wrong_goals"].tolist() == [1, 1, 0, 1, 1, 1]


def test_a_seed_names_the_layout_of_goal1_and_a_free_place_for_the_second_goal():
    task, plain = begun((), 300), make_task("goal1", 300, observe=())
    assert isinstance(plain, Goal)
    plain.reset(range(300))
    ours, theirs = task.snapshot(), plain.snapshot()
    for name in ("qpos", "hazards", "bodies"):
        np.testing.assert_array_equal(ours[name], theirs[name])
    first = (ours["goal"] == theirs["goal"]).all(axis=1)
    second = np.where(first[:, None], ours["other"], ours["goal"])
    np.testing.assert_array_equal(
        np.where(first[:, None], ours["goal"], ours["other"]), theirs["goal"]
    )
    assert 0.4 < first.mean() < 0.6, "a toss says whose is whose"
    for things, keepout in (
        (theirs["goal"][:, None], GOAL_KEEPOUT),
        (ours["hazards"], HAZARD_KEEPOUT),
        (ours["qpos"][:, None, :2], AGENT_KEEPOUT),
    ):
        assert (np.linalg.norm(things - second[:, None], axis=2) >= keepout + GOAL_KEEPOUT).all()
    assert (np.abs(second) <= 1.5 - GOAL_KEEPOUT).all()
