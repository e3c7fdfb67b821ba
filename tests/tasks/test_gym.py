"""The tasks as gymnasium environments: one episode, batches, copies."""

import copy
import os
import pickle
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TimeAwareObservation, TimeLimit

from wasp_cli.errors import TaskError, UsageError
from wasp_cli.tasks.gym import TaskEnv, TaskVectorEnv
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS

ID = "wasp/SafetyPointGoal1-v0"
INFO = ["cost", "cost_sum", "cost_hazards", "goals", "success"]


def text(value: Any) -> Any:
    """Everything in a result, to the bit."""
    if isinstance(value, dict):
        return {name: text(part) for name, part in value.items()}
    if isinstance(value, tuple):
        return [text(part) for part in value]
    if value is None:
        return None
    array = np.asarray(value)
    return (
        str(array.dtype),
        array.shape,
        [text(part) for part in array] if array.dtype == object else array.tobytes(),
    )


def drive(env: Any, steps: int, seed: int) -> list[Any]:
    """Random steps, and in the middle a reset whose layout the environment's own generator
    draws.
    """
    random, results = np.random.default_rng(seed), []
    for number in range(steps):
        results.append(text(env.step(random.uniform(-1, 1, env.action_space.shape))))
        if number == steps // 2:
            results.append(text(env.reset()))
    return results


# -- one episode


@pytest.mark.filterwarnings("ignore:.*Box observation space (min|max)imum value is.*")
@pytest.mark.parametrize("observation", ["state", "pixels", "privileged", "all"])
def test_gymnasium_accepts_it(observation):
    check_env(gymnasium.make(ID, observation=observation, render_mode="rgb_array").unwrapped)


def test_make_by_module_name_needs_no_import_and_registration_no_mujoco():
    code = (
        "import sys, wasp_cli, wasp_cli.tasks.gym, wasp_cli.tasks.sheet; print('mujoco' in "
        "sys.modules)"
    )
    code = (
        f"{code}; import gymnasium; e = gymnasium.make('wasp_cli.tasks.gym:{ID}'); "
        "print(e.reset(seed=0)[0].shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["False", "(60,)"]


def test_an_episode_ends_by_truncation_with_its_cost_in_info():
    env = gymnasium.make(ID, action_repeat=50)
    _, info = env.reset(seed=1)
    assert not any(info.values())
    for step in range(1, 21):
        assert list(info) == INFO
        assert [str(value.dtype) for value in info.values()] == ["float64"] * 3 + ["int64", "bool"]
        assert info["cost"] == info["cost_sum"] == info["cost_hazards"]
        _, _, terminated, truncated, info = env.step(np.array([1.0, 0.3]))
        assert (terminated, truncated) == (False, step == 20)
    with pytest.raises(TaskError, match="after the end"):
        env.step(np.array([0.0, 0.0]))


def test_seeds_name_episodes_and_without_one_or_beyond_the_layouts_one_is_drawn():
    """Minari seeds every reset without a seed with 64 bits."""
    env, again = gymnasium.make(ID), gymnasium.make(ID)
    for seed in (4, 2**32, 2**64 - 1):
        first = text(env.reset(seed=seed))
        assert first == text(again.reset(seed=seed))
        second = text(env.reset())
        assert second == text(again.reset()) != first


def test_maps_are_square_pictures_of_the_asked_size():
    env = gymnasium.make(ID, render_mode="rgb_array", width=96, height=96)
    env.reset(seed=0)
    assert (env.render().shape, env.render().dtype, env.metadata["render_fps"]) == (
        (96, 96, 3),
        np.uint8,
        50,
    )
    assert TaskEnv("goal1").render() is None
    for options, message in (
        ({"width": 64, "height": 32}, "a map is square"),
        ({"render_mode": "human"}, "cannot render 'human'"),
    ):
        with pytest.raises(UsageError, match=message):
            TaskEnv("goal1", **options)


def test_an_environment_returns_to_a_pickled_snapshot_to_the_bit():
    env, other = (
        gymnasium.make(ID, observation="all", action_repeat=20).unwrapped for _ in range(2)
    )
    env.reset(seed=3)
    other.reset(seed=4)
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    for action in actions[:15]:
        last = env.step(action)
    env._goals = 2  # counted in info, and part of what is kept
    kept = pickle.loads(pickle.dumps(env.snapshot()))
    future = [text(env.step(action)) for action in actions[15:]]
    for again in (env, other):
        assert text(again.restore(kept)) == text(last[0])
        assert [text(again.step(action)) for action in actions[15:]] == future
    with pytest.raises(TaskError, match="snapshot"):
        env.restore({"qpos": np.zeros(3)})


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        (np.array([np.nan, 0.0]), "not finite"),
        (np.array([1.0, 1j]), "array of real numbers, not ndarray of complex128"),
        (["1", "0"], "array of real numbers, not list"),
        (np.zeros((1, 2)), r"shape \(1, 2\), expected \(2,\)"),
        (None, "expected \\(2,\\)"),
    ],
    ids=str,
)
def test_wrong_actions_are_refused_and_change_nothing(action, expected):
    env = gymnasium.make(ID)
    env.reset(seed=0)
    before = text(env.unwrapped.snapshot())
    with pytest.raises(TaskError, match=expected):
        env.step(action)
    assert text(env.unwrapped.snapshot()) == before


@pytest.mark.parametrize(
    ("options", "expected", "hint"),
    [
        ({"observation": "pixel"}, "no observation 'pixel'", "'pixels'"),
        (
            {"observe": "pixels"},
            "got an unexpected keyword argument 'observe'.*no option 'observe'",
            "'observation'",
        ),
        ({"action_repeat": 0}, "action_repeat should be an integer of at least 1, not 0", None),
        (
            {"task": "race1"},
            f"'{ID}' is the task 'goal1', and task='race1' cannot change it",
            "wasp/SafetyCarRace1-v0",
        ),
    ],
)
def test_wrong_options_are_refused_with_a_suggestion(options, expected, hint):
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(UsageError, match=expected) as caught:
            make(ID, **options)
        assert isinstance(caught.value, TypeError) == ("observe" in options)
        # gymnasium.make raises TypeErrors anew, without hints: of an unknown option the message has
        # it.
        assert hint is None or hint in (caught.value.hint or caught.value.message)


def test_mujoco_that_does_not_import_is_an_expected_error():
    code = f"""
import gymnasium, pathlib, wasp_cli.tasks.gym, wasp_cli.tasks.sheet
from wasp_cli.errors import WaspError

for attempt in (
    lambda: gymnasium.make('{ID}'),
    lambda: gymnasium.make_vec('{ID}', num_envs=2),
    lambda: wasp_cli.tasks.sheet.draw_sheet('goal1', 0, pathlib.Path('never.png')),
):
    try:
        attempt()
    except WaspError as error:
        print(error.exit_code, error.message, error.hint)
print(pathlib.Path('never.png').exists())
"""
    environment = {**os.environ, "MUJOCO_GL": "foo"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment
    )
    *told, written = done.stdout.splitlines()
    assert (len(told), written) == (3, "False"), done.stderr
    assert all(
        line.startswith("2 MuJoCo does not import with MUJOCO_GL=foo") and "unset MUJOCO_GL" in line
        for line in told
    )


# -- many episodes


@pytest.mark.parametrize(
    ("mode", "limited"),
    [
        *((mode, {"action_repeat": 10, "max_episode_steps": 4}) for mode in AutoresetMode),
        (AutoresetMode.NEXT_STEP, {"action_repeat": 200}),
    ],
)
def test_every_autoreset_mode_is_gymnasiums_own(mode, limited):
    options = {"observation": "all", "num_envs": 3, **limited}
    ours = gymnasium.make_vec(f"wasp_cli.tasks.gym:{ID}", autoreset_mode=mode, **options)
    theirs = gymnasium.make_vec(
        ID, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **options
    )
    assert isinstance(ours, TaskVectorEnv)
    for space in (
        "observation_space",
        "single_observation_space",
        "action_space",
        "single_action_space",
    ):
        assert getattr(ours, space) == getattr(theirs, space)
    assert ours.autoreset_mode is theirs.autoreset_mode is ours.metadata["autoreset_mode"] is mode
    assert text(ours.reset(seed=5)) == text(theirs.reset(seed=5))
    random, ends = np.random.default_rng(0), 0
    for number in range(14):
        if number == 2:  # the episodes end in different steps from here on
            mask = np.array([False, True, False])
            one, other = (
                text(env.reset(seed=[None, 9, None], options={"reset_mask": mask.copy()}))
                for env in (ours, theirs)
            )
            assert one == other
        action = random.uniform(-1, 1, (3, 2))
        mine = ours.step(action)
        assert text(mine) == text(theirs.step(action)), number
        ended = mine[2] | mine[3]
        ends += int(ended.sum())
        if mode is AutoresetMode.DISABLED and ended.any():
            with pytest.raises(
                TaskError, match=f"after the end of row .*{np.flatnonzero(ended)[0]}"
            ):
                ours.step(action)
            seeds = [11 + row if over else None for row, over in enumerate(ended)]
            one, other = (
                text(env.reset(seed=list(seeds), options={"reset_mask": ended.copy()}))
                for env in (ours, theirs)
            )
            assert one == other
    assert ends >= 6


def test_the_cost_is_there_in_the_step_in_which_all_rows_restart():
    envs = gymnasium.make_vec(ID, num_envs=2, action_repeat=500)
    keys = envs.reset(seed=9)[1].keys()
    for _ in range(2):
        *_, truncated, infos = envs.step(np.full((2, 2), [1.0, 0.1]))
        assert infos.keys() == keys
    assert truncated.all()
    assert infos["goals"].any()
    infos = envs.step(np.ones((2, 2)))[4]
    assert infos.keys() == keys
    assert not infos["cost"].any()
    assert not infos["goals"].any()
    assert infos["_cost"].all()


def test_a_vector_answers_calls_for_its_episodes():
    envs = gymnasium.make_vec(
        ID, num_envs=3, render_mode="rgb_array", action_repeat=4, width=32, height=32
    )
    envs.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-1, 1, (2, 3, 2))
    first = envs.step(actions[0])
    held = copy.deepcopy(first)
    assert [picture.shape for picture in envs.render()] == [(32, 32, 3)] * 3
    assert envs.get_attr("max_episode_steps") == (250,) * 3
    one = gymnasium.make(ID, action_repeat=4).unwrapped
    one.restore(envs.call("snapshot")[1])
    assert text(one.step(actions[1, 1])[0]) == text(envs.step(actions[1])[0][1])
    assert text(first) == text(held), "results belong to the caller"


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda envs: envs.step(np.zeros((3, 2))), r"shape \(3, 2\), expected \(2, 2\)"),
        (lambda envs: envs.step(np.full((2, 2), np.nan)), "not finite"),
        (lambda envs: envs.reset(options={"level": 2}), "no option 'level'"),
        (lambda envs: gymnasium.make_vec(ID, num_envs=2).step(np.zeros((2, 2))), "reset"),
        (
            lambda envs: gymnasium.make_vec(ID, num_envs=2, upstream_api=True),
            "no option 'upstream_api'",
        ),
    ],
)
def test_a_vector_refuses_what_it_cannot_do(call, expected):
    envs = gymnasium.make_vec(ID, num_envs=2)
    envs.reset(seed=0)
    with pytest.raises((TaskError, UsageError), match=expected):
        call(envs)


# -- copies and specs


@pytest.mark.parametrize("task", list(TASKS))
def test_a_copy_of_an_environment_goes_on_bit_for_bit(task):
    env = gymnasium.make(
        TASKS[task].gym_id, observation="all", action_repeat=2, render_mode="rgb_array"
    )
    unbegun = copy.deepcopy(env)
    assert text(unbegun.reset(seed=4)) == text(env.reset(seed=4))
    drive(env, 4, 0)
    other = pickle.loads(pickle.dumps(env))
    assert text(other.render()) == text(env.render())
    assert drive(other, 6, 1) == drive(env, 6, 1)


def test_a_copy_of_a_batch_goes_on_bit_for_bit():
    envs = gymnasium.make_vec(
        "wasp/SafetyPointGoal2-v0", num_envs=3, observation="all", max_episode_steps=4, threads=2
    )
    envs.reset(seed=[1, None, 3])
    drive(envs, 3, 0)
    other = pickle.loads(pickle.dumps(envs))
    # through the ends of episodes, and the starts of others
    assert drive(other, 8, 1) == drive(envs, 8, 1)


@pytest.mark.parametrize("name", ["goal1", "formula1", "puddle:Puddle-v0"])
def test_a_snapshot_before_the_first_reset_is_refused(name):
    task = make_task(name, 3, observe=("state",))
    with pytest.raises(
        TaskError, match="before the first reset: no episode has begun in row 0, 1, 2"
    ) as caught:
        task.snapshot()
    assert caught.value.hint == "call reset first"
    task.reset([1], rows=np.array([False, True, False]))
    with pytest.raises(TaskError, match=r"in row 0, 2$"):
        task.snapshot()


@pytest.mark.parametrize(
    ("task", "repeat", "steps"), [("goal1", 1, 1000), ("goal1", 4, 250), ("race1", 3, 167)]
)
def test_the_spec_tells_the_time_limit(task, repeat, steps):
    env = gymnasium.make(TASKS[task].gym_id, action_repeat=repeat)
    assert (
        env.spec.max_episode_steps
        == env.unwrapped.spec.max_episode_steps
        == env.unwrapped.max_episode_steps
        == steps
    )
    assert (
        gymnasium.make(
            TASKS[task].gym_id, action_repeat=repeat, max_episode_steps=9
        ).spec.max_episode_steps
        == 9
    )
    assert TimeAwareObservation(env, normalize_time=True).max_timesteps == steps
    assert not isinstance(env.env, TimeLimit)
    assert TaskEnv(task).spec is None
