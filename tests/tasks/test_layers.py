"""What a foreign environment says of itself: the outermost wrapper that says something counts."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.tasks.lights import Lights, registered
from wasp_cli.errors import TaskError
from wasp_cli.tasks.foreign.examine import examine
from wasp_cli.tasks.foreign.task import GymTask
from wasp_cli.tasks.registry import TASKS


def wrapped(*layers: Any, env: type[Lights] = Lights, **options: Any) -> str:
    """Register an environment within wrappers, the innermost first."""

    def made() -> gymnasium.Env:
        stack = env()
        for layer in layers:
            stack = layer(stack)
        return stack

    return registered(made, **options)


def layer(**attributes: Any) -> type[gymnasium.Wrapper]:
    return type("Layer", (gymnasium.Wrapper,), attributes)


RATE = layer(metadata={"render_fps": 5})


def test_the_frame_rate_of_the_outermost_wrapper_counts():
    assert TASKS[wrapped()].env_seconds == 1 / 25
    assert TASKS[wrapped(RATE)].env_seconds == 1 / 5
    assert TASKS[wrapped(RATE, layer(metadata={"render_fps": 2}))].env_seconds == 1 / 2
    assert TASKS[wrapped(RATE, gymnasium.Wrapper)].env_seconds == 1 / 5
    assert GymTask(wrapped(RATE), 1, action_repeat=4).decision_seconds == 0.8


def test_a_wrapper_registered_beside_the_environment_counts_too():
    name = registered(Lights, additional_wrappers=(Slow.wrapper_spec(),))
    assert TASKS[name].env_seconds == 0.5


class Slow(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    dt = 0.5

    def __init__(self, env: gymnasium.Env):
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)


def test_a_time_of_a_step_counts_before_the_frame_rate_of_a_layer_below():
    assert TASKS[wrapped(layer(dt=0.3))].env_seconds == 0.3
    assert TASKS[wrapped(layer(dt=0.3), RATE)].env_seconds == 1 / 5


def test_the_goals_of_a_success_are_those_of_the_outermost_wrapper():
    many = layer(metadata={"success_goals": 3})
    assert TASKS[wrapped(many)].success_goals == 3
    assert TASKS[wrapped(many, RATE)].success_goals == 3


@pytest.mark.parametrize(
    ("layers", "registered_limit", "expected"),
    [
        ([layer(max_episode_steps=11)], None, 11),
        ([lambda env: gymnasium.wrappers.TimeLimit(env, 12)], None, 12),
        ([lambda env: gymnasium.wrappers.TimeLimit(env, 12), RATE], 500, 12),
        ([lambda env: gymnasium.wrappers.TimeLimit(env, 500)], 13, 13),
        ([layer(max_episode_steps=np.int64(14))], None, 14),
        ([], np.int32(15), 15),
    ],
)
def test_the_time_limit_is_the_least_of_all_layers(layers, registered_limit, expected):
    assert TASKS[wrapped(*layers, max_episode_steps=registered_limit)].env_steps == expected


@pytest.mark.parametrize("number", [np.float32(4), np.int64(4), np.array(4.0), np.array([4])])
def test_numbers_of_numpy_are_numbers(number):
    rates = layer(metadata={"render_fps": number, "success_goals": np.int64(2)})
    assert TASKS[wrapped(rates)].env_seconds == 0.25
    assert TASKS[wrapped(rates)].success_goals == 2
    assert TASKS[wrapped(layer(dt=np.float64(0.5)))].env_seconds == 0.5


@pytest.mark.parametrize("number", [True, "5", -1, 0, [5, 5], np.zeros(2)])
def test_what_is_no_rate_is_passed_over(number):
    assert TASKS[wrapped(layer(metadata={"render_fps": number}))].env_seconds == 1 / 25


def test_without_any_limit_the_environment_is_refused():
    with pytest.raises(TaskError, match="no time limit"):
        examine(wrapped(RATE, max_episode_steps=None))


def test_success_may_be_told_in_the_word_of_stable_baselines3():
    succeeds = type(
        "Succeeds",
        (Lights,),
        {"info": lambda self: {"cost": 0.0, "is_success": np.bool_(self.clock >= 6)}},
    )
    task = GymTask(registered(succeeds), 1)
    task.reset([0])
    assert [task.step(np.zeros((1, 2))).goals[0] for _ in range(3)] == [0, 1, 0]


def test_a_reset_without_a_seed_is_told_how_to_write_it():
    old = type("Old", (Lights,), {"reset": lambda self: (np.zeros((64, 64, 3), np.uint8), {})})
    with pytest.raises(TaskError) as caught:
        examine(registered(old))
    assert "def reset(self, *, seed=None, options=None)" in str(caught.value.hint)
