"""Two goals of equal look: nothing that an assistant may see tells them apart, and only one of them counts."""

import numpy as np

from wasp_cli.tasks.camera.topdown import from_above
from wasp_cli.tasks.goal.task import AGENT_KEEPOUT, GOAL_KEEPOUT, HAZARD_KEEPOUT, Goal
from wasp_cli.tasks.goal.two import TwoGoals
from wasp_cli.tasks.make import make_task

BATCH = 6


def begun(observe: tuple[str, ...] = ("pixels", "state", "privileged"), batch: int = BATCH) -> TwoGoals:
    task = make_task("goal1-two", batch, observe=observe)
    assert isinstance(task, TwoGoals)
    task.reset(range(batch))
    return task


def exchange(task: TwoGoals) -> None:
    """The other goal becomes the operator's."""
    state = task.snapshot()
    state["goal"], state["other"] = state["other"], state["goal"]
    task.restore(state)


def put_before(task: TwoGoals, name: str) -> None:
    """Set the robots down just outside a goal, at rest and facing it, with hazards and the vase out of the way."""
    state = task.snapshot()
    state["qpos"][:, :2] = state[name] - [0.302, 0.0]
    state["qpos"][:, 2], state["qvel"][:] = 0.0, 0.0
    state["bodies"][..., :2], state["hazards"][:] = 5.0, 50.0
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
    put_before(task, "other")
    before = task.snapshot()
    away = np.linalg.norm(before["goal"] - before["qpos"][:, :2], axis=1)
    step = task.step(forward)
    after = task.snapshot()
    assert (np.linalg.norm(after["other"] - after["qpos"][:, :2], axis=1) < task.goal_radius).all(), "the other one is reached"
    np.testing.assert_allclose(step.reward, away - np.linalg.norm(after["goal"] - after["qpos"][:, :2], axis=1), atol=1e-12)
    assert (step.goals == 0).all()
    assert (task.tallies()["wrong_goals"] == 1).all()
    np.testing.assert_array_equal(after["other"], before["other"])
    task.step(forward)
    assert (task.tallies()["wrong_goals"] == 1).all(), "staying there is no second visit"

    put_before(task, "goal")
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
    np.testing.assert_array_equal(np.where(first[:, None], ours["goal"], ours["other"]), theirs["goal"])
    assert 0.4 < first.mean() < 0.6, "a toss says whose is whose"
    for things, keepout in (
        (theirs["goal"][:, None], GOAL_KEEPOUT), (ours["hazards"], HAZARD_KEEPOUT), (ours["qpos"][:, None, :2], AGENT_KEEPOUT),
    ):  # fmt: skip
        assert (np.linalg.norm(things - second[:, None], axis=2) >= keepout + GOAL_KEEPOUT).all()
    assert (np.abs(second) <= 1.5 - GOAL_KEEPOUT).all()
