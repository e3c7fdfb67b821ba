"""Environments that travel: copies and pickles of them, and their specs."""

import copy
import hashlib
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import TimeAwareObservation, TimeLimit

import wasp_cli.tasks.gym
from wasp_cli.errors import TaskError, UnknownName, UnknownOption, UsageError
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.reference import MISSING, MISSING_MODES
from wasp_cli.tasks.registry import TASKS

ID = "wasp/SafetyPointGoal1-v0"
COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: cloudpickle.loads(cloudpickle.dumps(env)),
}


def text(value: Any) -> Any:
    """Everything in a result, to the bit."""
    if isinstance(value, dict):
        return {name: text(part) for name, part in value.items()}
    if isinstance(value, tuple):
        return [text(part) for part in value]
    array = np.asarray(value)
    return (str(array.dtype), array.shape, [text(part) for part in array] if array.dtype == object else array.tobytes())


def drive(env: Any, steps: int, seed: int) -> list[Any]:
    """Random steps, and in the middle a reset whose layout the environment's own generator draws."""
    random, seen = np.random.default_rng(seed), []
    for number in range(steps):
        seen.append(text(env.step(random.uniform(-1, 1, env.action_space.shape))))
        if number == steps // 2:
            seen.append(text(env.reset()))
    return seen


@pytest.mark.parametrize(("task", "how"), [*((task, "pickle") for task in TASKS), ("goal1", "deepcopy"), ("goal1", "cloudpickle")])
def test_a_copy_of_an_environment_goes_on_bit_for_bit(task, how):
    env = gymnasium.make(TASKS[task].gym_id, observation="all", action_repeat=2, render_mode="rgb_array")
    unbegun = COPIES[how](env)
    assert text(unbegun.reset(seed=4)) == text(env.reset(seed=4))
    drive(env, 6, 0)
    other = COPIES[how](env)
    assert other.unwrapped is not env.unwrapped
    assert text(other.render()) == text(env.render())
    assert drive(other, 8, 1) == drive(env, 8, 1)


@pytest.mark.parametrize(("task", "how"), [("goal2", "pickle"), ("formula1", "pickle"), ("goal1", "deepcopy"), ("goal1", "cloudpickle")])
def test_a_copy_of_a_batch_goes_on_bit_for_bit(task, how):
    envs = gymnasium.make_vec(TASKS[task].gym_id, num_envs=3, observation="all", max_episode_steps=4, threads=2)
    envs.reset(seed=[1, None, 3])
    drive(envs, 3, 0)
    other = COPIES[how](envs)
    assert drive(other, 8, 1) == drive(envs, 8, 1)  # through the ends of episodes, and the starts of others


@pytest.mark.parametrize("name", ["goal2", "race1", "formula1", "puddle:Puddle-v0"])
def test_a_copy_of_a_task_goes_on_bit_for_bit(name):
    task = make_task(name, 2, threads=2)
    task.reset([3, 4])
    action = np.full((2, task.action_size), 0.4)
    task.step(action)
    other = pickle.loads(pickle.dumps(task))
    for _ in range(4):
        assert text(tuple(other.step(action))[:7]) == text(tuple(task.step(action))[:7])


def test_what_a_copy_does_moves_nothing_in_the_original():
    env = gymnasium.make(ID, action_repeat=10)
    env.reset(seed=0)
    kept = env.unwrapped.snapshot()
    drive(copy.deepcopy(env), 5, 0)
    assert text(env.unwrapped.snapshot()) == text(kept)


def test_a_pickle_goes_on_in_another_process(tmp_path):
    env = gymnasium.make("wasp/SafetyCarFormulaOne1-v0", observation="pixels")
    env.reset(seed=2)
    env.step(np.array([1.0, 1.0]))
    (tmp_path / "env").write_bytes(pickle.dumps(env))
    code = "import pickle, sys, numpy as np; e = pickle.load(open(sys.argv[1], 'rb')); o, r, *_ = e.step(np.array([1.0, 0.5]))\n"
    code += "import hashlib; print(hashlib.sha256(o.tobytes()).hexdigest(), repr(float(r)))"
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "env")], capture_output=True, text=True, check=True)
    observation, reward, *_ = env.step(np.array([1.0, 0.5]))
    assert done.stdout.split() == [hashlib.sha256(observation.tobytes()).hexdigest(), repr(float(reward))]


@pytest.mark.parametrize("name", ["goal1", "formula1", "puddle:Puddle-v0"])
def test_a_snapshot_before_the_first_reset_is_refused(name):
    task = make_task(name, 3, observe=("state",))
    with pytest.raises(TaskError, match="before the first reset: no episode has begun in row 0, 1, 2") as caught:
        task.snapshot()
    assert caught.value.hint == "call reset first"
    task.reset([1], rows=np.array([False, True, False]))
    with pytest.raises(TaskError, match=r"in row 0, 2$"):
        task.snapshot()
    task.reset([1, 2], rows=np.array([True, False, True]))
    kept = task.snapshot()
    other = make_task(name, 3, observe=("state",))
    if name.startswith("puddle"):
        other.reset([0, 0, 0])  # somebody else's environment may want that
    other.restore(kept)
    assert text(other.snapshot()) == text(kept)


@pytest.mark.parametrize(("task", "repeat", "steps"), [("goal1", 1, 1000), ("goal1", 4, 250), ("race1", 3, 167), ("formula1", 1, 1000)])
def test_the_spec_tells_the_time_limit(task, repeat, steps):
    env = gymnasium.make(TASKS[task].gym_id, action_repeat=repeat)
    assert env.spec.max_episode_steps == env.unwrapped.spec.max_episode_steps == env.unwrapped.max_episode_steps == steps
    assert gymnasium.make(TASKS[task].gym_id, action_repeat=repeat, max_episode_steps=9).spec.max_episode_steps == 9
    assert TimeAwareObservation(env, normalize_time=True).max_timesteps == steps
    assert not isinstance(env.env, TimeLimit)
    assert gymnasium.spec(TASKS[task].gym_id).max_episode_steps is None  # what is registered knows no action_repeat
    assert wasp_cli.tasks.gym.TaskEnv(task).spec is None


@pytest.mark.parametrize("values", [5, 6])
def test_the_spec_makes_the_same_environment_again(values):
    env = gymnasium.make(ID, upstream_api=values == 6, action_repeat=250, observation="privileged")
    assert env.spec.max_episode_steps == 4
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    for other in (again, gymnasium.make(again.spec)):
        layer = other
        while isinstance(layer, gymnasium.Wrapper):
            assert values == 5 or not isinstance(layer, TimeLimit)
            layer = layer.env
        assert other.spec == env.spec
        assert text(env.reset(seed=1)) == text(other.reset(seed=1))
        for _ in range(4):
            action = np.array([1.0, 0.3])
            last = env.step(action)
            assert text(last) == text(other.step(action))
        assert len(last) == values
        assert last[-2]
    copied = copy.deepcopy(again)
    assert len(copied.reset(seed=0)) == 2
    assert len(copied.step(np.zeros(2))) == values


def test_the_spec_of_a_vector_makes_it_again():
    envs = gymnasium.make_vec(ID, num_envs=2, action_repeat=250, autoreset_mode="SameStep")
    again = gymnasium.make_vec(envs.spec)
    assert again.autoreset_mode is envs.autoreset_mode
    assert gymnasium.make_vec(again.spec).spec == again.spec
    assert text(envs.reset(seed=1)) == text(again.reset(seed=1))
    for _ in range(6):
        assert text(envs.step(np.ones((2, 2)))) == text(again.step(np.ones((2, 2))))


def test_reset_tells_the_keys_of_a_step_with_zeros():
    for task in TASKS:
        env = gymnasium.make(TASKS[task].gym_id)
        _, first = env.reset(seed=0)
        *_, info = env.step(np.zeros(2))
        assert list(first) == list(info)
        assert [type(first[name]) for name in first] == [type(info[name]) for name in info]
        assert not any(first.values())


def test_what_info_tells_are_numbers_of_numpy_by_source():
    env = gymnasium.make("wasp/SafetyPointGoal2-v0", action_repeat=25)
    _, info = env.reset(seed=0)
    costs = []
    for _ in range(30):
        assert list(info) == ["cost", "cost_sum", "cost_hazards", "cost_vases_contact", "cost_vases_velocity", "goals", "success"]
        assert [str(value.dtype) for value in info.values()] == ["float64"] * 5 + ["int64", "bool"]
        assert isinstance(info["cost"], np.float64)
        assert info["cost"] == info["cost_sum"] <= sum(info[name] for name in list(info)[2:5])
        costs.append(info["cost"])
        *_, info = env.step(np.array([1.0, 0.2]))
    assert any(costs)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("checked", [True, False])
def test_actions_of_either_width_give_no_warning(kind, checked):
    env, envs = gymnasium.make(ID, disable_env_checker=not checked), gymnasium.make_vec(ID, num_envs=2)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box observation space (min|max)imum value is.*")
        env.reset(seed=0)
        warnings.simplefilter("error")
        envs.reset(seed=0)
        for _ in range(3):
            assert env.action_space.contains(np.full(2, 0.5, kind))
            env.step(np.full(2, 0.5, kind))
            envs.step(np.full((2, 2), 0.5, kind))


def test_an_unknown_option_is_a_type_error_in_pythons_words():
    for make, made in ((gymnasium.make, "TaskEnv"), (gymnasium.make_vec, "TaskVectorEnv")):
        with pytest.raises(TypeError, match="got an unexpected keyword argument 'frameskip'") as caught:
            make(ID, frameskip=4)
        assert isinstance(caught.value, UnknownOption)
        assert made in str(caught.value)
    with pytest.raises(TypeError, match="did you mean 'action_repeat'"):
        wasp_cli.tasks.gym.TaskEnv("goal1", action_repeats=2)


BODY = ["accelerometer", "velocimeter", "gyro", "magnetometer"]
CASTER = ["ballangvel_rear", "ballquat_rear"]


@pytest.mark.parametrize(
    ("name", "sensors"),
    [
        ("SafetyPointGoal1", [*BODY, "goal_lidar", "hazards_lidar", "vases_lidar"]),
        ("SafetyPointGoal0", [*BODY, "goal_lidar"]),
        ("SafetyCarRace1", [*BODY, *CASTER, "goal_lidar", "hazards_lidar"]),
        ("SafetyCarFormulaOne1", [*BODY, *CASTER, "staged_goal_lidar", "vases_lidar"]),
    ],
)
def test_upstream_takes_vision_ids(name, sensors):
    env, plain = wasp_cli.tasks.gym.upstream(f"{name}Vision-v0"), gymnasium.make(f"wasp/{name}-v0", observation="all")
    seen, _ = env.reset(seed=3)
    everything, _ = plain.reset(seed=3)
    for _ in range(2):
        assert list(seen) == [*sensors, "vision"]
        assert env.observation_space.contains(seen)
        assert np.concatenate([seen[name].ravel() for name in sensors]).tobytes() == everything["state"].tobytes()
        assert (seen["vision"] == np.moveaxis(everything["pixels"][:3], 0, -1)).all()
        six = env.step(np.array([1.0, 0.5]))
        seen, everything = six[0], plain.step(np.array([1.0, 0.5]))[0]
    assert len(six) == 6


def test_upstream_takes_gymnasium_ids():
    env = wasp_cli.tasks.gym.upstream(id="SafetyPointGoal1Gymnasium-v0", max_episode_steps=7)
    env.reset(seed=0)
    *_, info = env.step(np.zeros(2))
    assert info["cost"] == info["cost_hazards"] == 0.0
    assert env.spec.max_episode_steps == 7
    both = wasp_cli.tasks.gym.upstream("wasp/SafetyCarRace1VisionGymnasium-v0")
    assert both.reset(seed=0)[0]["vision"].shape == (64, 64, 3)
    assert len(both.step(np.zeros(2))) == 5


def test_pictures_have_the_asked_size():
    env = wasp_cli.tasks.gym.upstream("SafetyPointGoal1-v0", render_mode="rgb_array", width=96, height=96)
    env.reset(seed=0)
    assert env.render().shape == (96, 96, 3)
    for width, height in ((64, 32), (0, 0), (64.0, 64.0)):
        with pytest.raises(UsageError, match="a map is square"):
            gymnasium.make(ID, render_mode="rgb_array", width=width, height=height)


def test_upstream_says_what_it_does_not_have():
    for option, instead in MISSING.items():
        with pytest.raises(UnknownOption, match=f"unexpected keyword argument '{option}'") as caught:
            wasp_cli.tasks.gym.upstream("SafetyPointGoal1-v0", **{option: 1})
        assert instead in caught.value.message
    for mode in MISSING_MODES:
        with pytest.raises(UsageError, match=f"cannot render '{mode}'"):
            wasp_cli.tasks.gym.upstream("SafetyPointGoal1-v0", render_mode=mode)
    with pytest.raises(UsageError, match="keyboard"):
        wasp_cli.tasks.gym.upstream("SafetyPointGoal1Debug-v0")
    with pytest.raises(UnknownName, match="SafetyPointButton1"):
        wasp_cli.tasks.gym.upstream("SafetyPointButton1Vision-v0")
    listed = (Path(__file__).parents[2] / "docs/tasks.md").read_text()
    assert all(f"`{name}`" in listed for name in (*MISSING, *MISSING_MODES))
