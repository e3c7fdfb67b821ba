"""What every task promises, run over every entry of the registry, and over environments of
others.
"""

import gymnasium
import numpy as np
import pytest

from tests.tasks.test_gym import text
from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import Observation, VectorTask
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS

gymnasium.register(
    "GoalThroughGymnasium-v0",
    entry_point="wasp_cli.tasks.gym:TaskEnv",
    kwargs={"task": "goal1", "observation": "all"},
    max_episode_steps=1000,
)
FOREIGN = ["puddle:Puddle-v0", "GoalThroughGymnasium-v0"]
NAMES = [*TASKS, *FOREIGN]
ALL = ("pixels", "state", "privileged")
BATCH = 3


@pytest.fixture(params=NAMES)
def name(request) -> str:
    return request.param


def actions(task: VectorTask, steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(
        task.action_low, task.action_high, (steps, task.batch, task.action_size)
    )


def check_observation(task: VectorTask, seen: Observation) -> None:
    assert (seen.pixels.shape, seen.pixels.dtype) == ((task.batch, 6, 64, 64), np.uint8)
    assert (seen.state.shape, seen.state.dtype) == ((task.batch, task.state_size), np.float64)
    assert (seen.privileged.shape, seen.privileged.dtype) == (
        (task.batch, task.privileged_size),
        np.float32,
    )
    assert np.isfinite(seen.state).all()
    assert np.isfinite(seen.privileged).all()


def test_shapes_and_types(name):
    task = make_task(name, BATCH, observe=ALL)
    info = TASKS[name]
    assert task.decision_seconds == pytest.approx(info.env_seconds * task.action_repeat)
    assert task.max_decisions == -(-info.env_steps // task.action_repeat)
    assert task.action_low.shape == task.action_high.shape == (task.action_size,)
    check_observation(task, task.reset([0, 1, 2]))
    step = task.step(actions(task, 1)[0])
    check_observation(task, step.observation)
    for value, dtype in (
        (step.reward, np.float64),
        (step.cost, np.bool_),
        (step.cost_env, np.int64),
        (step.goals, np.int64),
        (step.env_steps, np.int64),
        (step.ended, np.bool_),
        (step.terminated, np.bool_),
        *((count, np.int64) for count in step.sources.values()),
    ):
        assert (value.shape, value.dtype) == ((BATCH,), dtype)
    assert tuple(step.sources) == task.cost_sources
    assert (step.env_steps == task.action_repeat).all()


def test_only_what_was_asked_for_is_shown(name):
    assert [field is None for field in make_task(name, 1, observe=("state",)).reset([0])] == [
        True,
        False,
        True,
    ]
    assert [field is None for field in make_task(name, 1, observe=()).reset([0])] == [
        True,
        True,
        True,
    ]


def test_a_seed_names_an_episode(name):
    one, two = make_task(name, BATCH, observe=ALL), make_task(name, BATCH, observe=ALL)
    assert text(one.reset([5, 6, 5])) == text(two.reset([5, 6, 5]))
    for action in actions(one, 5):
        action[2] = action[0]
        step = one.step(action)
        assert text(step) == text(two.step(action))
    assert step.observation.state[0].tobytes() == step.observation.state[2].tobytes()
    assert step.observation.state[0].tobytes() != step.observation.state[1].tobytes()


def test_results_belong_to_the_caller(name):
    task = make_task(name, BATCH, observe=ALL)
    seen = task.reset([0, 1, 2])
    before = text(seen)
    kept = task.snapshot()
    copy = {key: array.copy() for key, array in kept.items()}
    step = task.step(actions(task, 1)[0])
    held = text(step)
    task.step(actions(task, 1, seed=1)[0])
    assert text(seen) == before
    assert text(step) == held
    assert all(array.tobytes() == copy[key].tobytes() for key, array in kept.items())


def test_restore_is_bit_exact(name):
    task, other = make_task(name, BATCH, observe=ALL), make_task(name, BATCH, observe=ALL)
    task.reset([1, 2, 3])
    other.reset([7, 8, 9])
    for action in actions(task, 4):
        last = task.step(action)
    kept = task.snapshot()
    plan = actions(task, 6, seed=1)
    future = [text(task.step(action)) for action in plan]
    for again in (task, other):
        assert text(again.restore(kept)) == text(last.observation)
        assert [text(again.step(action)) for action in plan] == future


# levels are of the same classes, and episodes are long
@pytest.mark.parametrize("name", ["goal1", "race1", "formula1", FOREIGN[0]])
def test_a_finished_episode_stays_finished_until_its_own_reset(name):
    task = make_task(name, 2, observe=("state", "privileged"))
    task.reset([0, 1])
    rest = np.zeros((2, task.action_size))
    for _ in range(5):
        task.step(rest)
    task.reset([2], rows=np.array([False, True]))
    for _ in range(task.max_decisions - 5):
        step = task.step(rest)
    assert step.ended.tolist() == [True, False]
    frozen = step.observation
    step = task.step(actions(task, 1)[0])
    assert step.observation.state[0].tobytes() == frozen.state[0].tobytes()
    assert (step.reward[0], step.cost[0], step.cost_env[0], step.goals[0], step.env_steps[0]) == (
        0.0,
        False,
        0,
        0,
        0,
    )
    assert step.env_steps[1] == task.action_repeat

    task.reset([3], rows=np.array([True, False]))
    step = task.step(rest)
    assert step.ended.tolist() == [False, False]


def test_resetting_a_row_leaves_the_others_alone(name):
    task, undisturbed = make_task(name, BATCH, observe=ALL), make_task(name, BATCH, observe=ALL)
    for each in (task, undisturbed):
        each.reset([1, 2, 3])
        each.step(actions(task, 1)[0])
    seen = task.reset([9], rows=np.array([False, True, False]))
    fresh = make_task(name, 1, observe=ALL).reset([9])
    for ours, alone in zip(seen, fresh, strict=True):
        assert ours[1].tobytes() == alone[0].tobytes()
    action = actions(task, 1, seed=2)[0]
    for ours, theirs in zip(
        task.step(action).observation, undisturbed.step(action).observation, strict=True
    ):
        assert ours[[0, 2]].tobytes() == theirs[[0, 2]].tobytes()


def test_actions_are_clipped(name):
    task, other = make_task(name, 1, observe=("state",)), make_task(name, 1, observe=("state",))
    task.reset([0])
    other.reset([0])
    assert text(task.step(np.full((1, task.action_size), 7.0))) == text(
        other.step(task.action_high[None])
    )


@pytest.mark.parametrize("wrong", ["shape", "nan", "infinite"])
def test_wrong_actions_are_errors_and_change_nothing(name, wrong):
    task = make_task(name, 2, observe=("state",))
    task.reset([0, 1])
    action = np.zeros((3 if wrong == "shape" else 2, task.action_size))
    if wrong != "shape":
        action[1, 0] = np.nan if wrong == "nan" else np.inf
    before = task.snapshot()
    with pytest.raises(
        TaskError, match=r"shape \(3" if wrong == "shape" else "row 1 is not finite"
    ):
        task.step(action)
    assert all(array.tobytes() == before[key].tobytes() for key, array in task.snapshot().items())


def test_wrong_resets_are_errors(name):
    task = make_task(name, 2, observe=())
    with pytest.raises(TaskError, match="seeds"):
        task.reset([0])
    with pytest.raises(TaskError, match="seeds"):
        task.reset([0, 1], rows=np.array([True, False]))
    with pytest.raises(TaskError, match="rows"):
        task.reset([0], rows=np.array([True]))
    with pytest.raises(TaskError, match="out of range"):
        task.reset([0, -1])
    with pytest.raises(TaskError, match="reset"):
        task.step(np.zeros((2, task.action_size)))
