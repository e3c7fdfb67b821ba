"""Gymnasium environments of others as tasks: what the adapter makes of them."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.tasks.lights import Lights, registered
from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import Observation
from wasp_cli.tasks.foreign.task import GymTask
from wasp_cli.tasks.foreign.views import views_of
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS, is_foreign, task_named


def test_our_own_task_through_gymnasium_is_the_task_itself_to_the_bit():
    name = registered("wasp_cli.tasks.gym:TaskEnv", kwargs={"task": "goal1", "observation": "all"}, max_episode_steps=1000)
    native, through = make_task("goal1", 1), make_task(name, 1)
    assert isinstance(through, GymTask)
    for facts in ("decision_seconds", "max_decisions", "cost_sources", "state_size", "privileged_size", "action_size"):
        assert getattr(through, facts) == getattr(native, facts)

    def flat(result: Any) -> list[Any]:
        return [flat(part) if isinstance(part, tuple) else part for part in result]

    seeds = [9]  # straight on, there are hazards
    np.testing.assert_equal(flat(through.reset(seeds)), flat(native.reset(seeds)))
    random, cost = np.random.default_rng(0), 0
    for _ in range(250):
        action = np.array([[1.0, 0.1]]) + random.normal(0, 0.02, (1, 2))
        ours, theirs = through.step(action), native.step(action)
        # The privileged vector holds the mean turn over a decision step, of which the environment sees the last env step.
        ours, theirs = (step._replace(observation=step.observation._replace(privileged=None)) for step in (ours, theirs))
        np.testing.assert_equal(flat(ours), flat(theirs))
        cost += int(theirs.cost_env.sum())
    assert theirs.ended.all()
    assert cost > 0


def test_commands_in_unit_bounds_reach_the_environments_own():
    task = GymTask(registered(Lights), 3, action_repeat=2)
    assert (task.action_low.tolist(), task.action_high.tolist()) == ([-1, -1], [1, 1])
    task.reset([0, 1, 2])
    task.step(np.array([[-1.0, -1.0], [0.5, 0.5], [1.0, 99.0]]))
    got = [env.unwrapped.got for env in task._envs]
    for row, expected in zip(got, ([-2.0, 0.0], [2.5, 7.5], [4.0, 10.0]), strict=True):
        np.testing.assert_array_equal(row, [expected] * 2)


def test_an_action_of_any_shape_and_type_is_given_as_the_space_has_it():
    class Shaped(Lights):
        action_space = gymnasium.spaces.Box(-0.1, 0.1, (2, 3), np.float32)

    task = GymTask(registered(Shaped), 1)
    assert task.action_size == 6
    task.reset([0])
    task.step(np.linspace(-1, 1, 6)[None])
    action = task._envs[0].unwrapped.got[0]
    assert (action.shape, action.dtype) == ((2, 3), np.float32)
    assert Shaped.action_space.contains(action)
    np.testing.assert_allclose(action.ravel(), np.linspace(-0.1, 0.1, 6), atol=1e-7)


def test_rewards_and_costs_add_up_and_the_time_limit_cuts_the_last_decision():
    task = GymTask(registered(Lights, max_episode_steps=10), 1, action_repeat=4)
    assert (task.max_decisions, task.decision_seconds) == (3, 0.16)
    task.reset([0])
    steps = [task.step(np.zeros((1, 2))) for _ in range(3)]
    assert [step.reward[0] for step in steps] == [4, 4, 2]
    assert [step.env_steps[0] for step in steps] == [4, 4, 2]
    assert [step.cost_env[0] for step in steps] == [1, 1, 1]
    assert [step.sources["cost"][0] for step in steps] == [1, 1, 1]
    assert [(step.ended[0], step.terminated[0]) for step in steps] == [(False, False), (False, False), (True, False)]
    with pytest.raises(TaskError, match="after the end"):
        task.step(np.zeros((1, 2)))


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        (lambda clock: {"goals": clock // 3}, [1, 1, 2]),
        (lambda clock: {"success": clock == 6}, [0, 1, 0]),
        (lambda clock: {"success": clock >= 2}, [1, 0, 0]),
        (lambda clock: {}, [0, 0, 0]),
    ],
    ids=["goals", "a success that passes", "a success that stays", "nothing"],
)
def test_goals_and_success(told, expected):
    class Scoring(Lights):
        def info(self):
            return super().info() | told(self.clock)

    task = GymTask(registered(Scoring), 1)
    for _ in range(2):  # a new episode counts from nothing
        task.reset([0])
        assert [task.step(np.zeros((1, 2))).goals[0] for _ in range(3)] == expected


@pytest.mark.parametrize(
    ("costs", "sources"),
    [
        ({"cost_sum": 1.0, "cost_wet": 1.0, "cost_cold": 0.0}, ("wet", "cold")),  # as in Safety-Gymnasium
        ({"cost_sum": 1.0}, ("cost",)),
        ({"cost_limit": 25.0}, ("cost",)),  # a number like another
    ],
)
def test_costs_may_be_told_flat(costs, sources):
    class Flat(Lights):
        def info(self):
            return {"cost": 1.0, **costs}

    task = GymTask(registered(Flat), 1)
    task.reset([0])
    step = task.step(np.zeros((1, 2)))
    assert task.cost_sources == sources
    assert {name: int(count[0]) for name, count in step.sources.items()} == {name: 4 * (name != "cold") for name in sources}


BOX = gymnasium.spaces.Box
RANDOM = np.random.default_rng(0).integers(0, 256, (64, 64, 6), np.uint8)


@pytest.mark.parametrize(
    ("space", "observation", "rear"),
    [
        (BOX(0, 255, (64, 64, 3), np.uint8), RANDOM[..., :3], False),
        (BOX(0, 255, (3, 64, 64), np.uint8), np.moveaxis(RANDOM[..., :3], -1, 0), False),
        (BOX(0, 255, (64, 64, 6), np.uint8), RANDOM, True),
        (BOX(0, 255, (6, 64, 64), np.uint8), np.moveaxis(RANDOM, -1, 0), True),
        (gymnasium.spaces.Dict(vision=BOX(0, 255, (64, 64, 3), np.uint8)), {"vision": RANDOM[..., :3]}, False),
        (
            gymnasium.spaces.Dict(image=BOX(0, 255, (64, 64, 3), np.uint8), image2=BOX(0, 255, (3, 64, 64), np.uint8)),
            {"image": RANDOM[..., :3], "image2": np.moveaxis(RANDOM[..., 3:], -1, 0)},
            True,
        ),
    ],
)
def test_every_form_of_an_image_becomes_the_same_pixels(space, observation, rear):
    views = views_of(space)
    expected = np.moveaxis(RANDOM, -1, 0).copy()
    if not rear:
        expected[3:] = 0
    np.testing.assert_array_equal(views.pixels(observation), expected)
    assert views.privileged_size == (768 if rear else 384)


def test_without_vectors_a_coarse_image_and_its_change_stand_in():
    task = GymTask(registered(Lights), 2)
    first = task.reset([0, 1])
    assert first.privileged.shape == (2, 384)
    assert (first.privileged == 0).all()
    second = task.step(np.zeros((2, 2))).observation
    np.testing.assert_allclose(second.privileged[0], 4 / 255, rtol=1e-6)
    third = task.step(np.zeros((2, 2))).observation.privileged
    np.testing.assert_allclose(third[0, :192], 8 / 255, rtol=1e-6)
    np.testing.assert_allclose(third[0, 192:], 4 / 255, rtol=1e-5)
    assert (second.state == second.privileged).all()


@pytest.mark.parametrize(("entries", "privileged", "state"), [(("privileged", "state"), 5, 7), (("privileged",), 5, 5), (("state",), 7, 7)])
def test_vectors_of_a_dictionary_are_taken_by_name(entries, privileged, state):
    sizes = {"privileged": 5, "state": 7}
    spaces = {"image": BOX(0, 255, (64, 64, 3), np.uint8)} | {name: BOX(-np.inf, np.inf, (sizes[name],), np.float64) for name in entries}

    class Vectors(Lights):
        observation_space = gymnasium.spaces.Dict(spaces)

        def seen(self):
            return {"image": super().seen()} | {name: np.full(sizes[name], sizes[name] + self.clock, float) for name in entries}

    task = GymTask(registered(Vectors), 1)
    assert (task.privileged_size, task.state_size) == (privileged, state)
    seen: Observation = task.reset([0])
    np.testing.assert_array_equal(seen.privileged, np.full((1, privileged), privileged))
    np.testing.assert_array_equal(seen.state, np.full((1, state), state))


def test_an_environment_without_snapshots_works_and_says_so_when_asked():
    task = GymTask(registered(Lights), 1)
    task.reset([0])
    task.step(np.zeros((1, 2)))
    with pytest.raises(TaskError, match="has no method 'snapshot'") as caught:
        task.snapshot()
    assert "restore" in str(caught.value.hint)
    other = make_task("puddle:Puddle-v0", 1)
    other.reset([0])
    with pytest.raises(TaskError, match="not one of this task"):
        other.restore({"goals": np.zeros(5)})


@pytest.mark.parametrize("name", ["my_pkg:MyEnv-v0", "my.pkg:space/My-Env-v12", "MyEnv-v0", "space/MyEnv", "pkg:MyEnv"])
def test_gymnasium_ids_are_names_of_tasks(name):
    assert is_foreign(name)
    info = TASKS[name]
    assert (info.name, info.title) == (name, name.rpartition(":")[2])
    assert name not in list(TASKS)


def test_our_own_ids_have_their_own_names():
    for text in ("goal1", "wasp/SafetyPointGoal1-v0", "SafetyPointGoal1-v0", "wasp_cli.tasks.gym:wasp/SafetyPointGoal1-v0"):
        assert task_named(text) == "goal1"
