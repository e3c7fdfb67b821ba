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

import wasp_cli.tasks.gym
import wasp_cli.tasks.gym_vector
from wasp_cli.errors import TaskError, UnknownName, UsageError
from wasp_cli.tasks.make import make_task

ID = "wasp/SafetyPointGoal1-v0"


@pytest.mark.filterwarnings("ignore:.*Box observation space (min|max)imum value is.*")
@pytest.mark.parametrize("observation", ["state", "pixels", "privileged", "all"])
def test_gymnasium_accepts_it(observation):
    env = gymnasium.make(ID, observation=observation, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def test_make_by_module_name_needs_no_import_and_registration_no_mujoco():
    code = "import sys, wasp_cli, wasp_cli.tasks.gym, wasp_cli.tasks.sheet; print('mujoco' in sys.modules)"
    code = f"{code}; import gymnasium; e = gymnasium.make('wasp_cli.tasks.gym:{ID}'); print(e.reset(seed=0)[0].shape)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["False", "(60,)"]


def test_an_episode_ends_by_truncation_with_its_cost_in_info():
    env = gymnasium.make(ID, action_repeat=50)
    env.reset(seed=1)
    lengths, costs = 0, 0.0
    truncated = False
    while not truncated:
        _, _, terminated, truncated, info = env.step(np.array([1.0, 0.3]))
        assert not terminated
        assert info["cost"] == info["cost_sum"] == info["cost_hazards"]
        assert {"cost", "cost_sum", "cost_hazards", "goals", "success"} == info.keys()
        lengths, costs = lengths + 1, costs + info["cost"]
    assert lengths == 20
    with pytest.raises(TaskError, match="after the end"):
        env.step(np.array([0.0, 0.0]))


def test_seeds_name_episodes():
    env = gymnasium.make(ID, observation="privileged")
    first, second = env.reset(seed=4)[0], env.reset()[0]
    assert (first == env.reset(seed=4)[0]).all()
    assert (second == env.reset()[0]).all()
    assert (first != second).any()


def test_success_counts_goals(monkeypatch):
    env = wasp_cli.tasks.gym.TaskEnv("goal1", "privileged")
    env.reset(seed=0)
    env._goals = 7
    assert env.step(np.zeros(2))[4]["success"]
    env.reset(seed=0)
    assert not env.step(np.zeros(2))[4]["success"]


def test_rendering():
    env = gymnasium.make(ID, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (256, 256, 3)
    assert picture.dtype == np.uint8
    assert env.metadata["render_fps"] == 50
    with pytest.raises(UsageError, match="cannot render"):
        wasp_cli.tasks.gym.TaskEnv("goal1", render_mode="human")
    assert wasp_cli.tasks.gym.TaskEnv("goal1").render() is None


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return isinstance(other, dict) and one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(same(mine, theirs) for mine, theirs in zip(one, other, strict=True))
    if one is None or other is None:
        return one is other
    one, other = np.asarray(one), np.asarray(other)
    if one.dtype == other.dtype == object:
        return len(one) == len(other) and all(same(mine, theirs) for mine, theirs in zip(one, other, strict=True))
    return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())


def vectors_with(mode: AutoresetMode, **options: Any) -> tuple[gymnasium.vector.VectorEnv, gymnasium.vector.VectorEnv]:
    return (
        gymnasium.make_vec(ID, num_envs=3, autoreset_mode=mode, **options),
        gymnasium.make_vec(ID, num_envs=3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **options),
    )


@pytest.mark.parametrize(
    ("mode", "limited"), [*((mode, {}) for mode in AutoresetMode), (AutoresetMode.SAME_STEP, {"max_episode_steps": 3})]
)
def test_every_autoreset_mode_is_gymnasiums_own(mode, limited):
    ours, theirs = vectors_with(mode, action_repeat=200, observation="all", **limited)
    for space in ("observation_space", "single_observation_space", "action_space", "single_action_space"):
        assert getattr(ours, space) == getattr(theirs, space)
    assert ours.autoreset_mode is theirs.autoreset_mode is ours.metadata["autoreset_mode"] is mode
    assert same(ours.reset(seed=5), theirs.reset(seed=5))
    random, ends = np.random.default_rng(0), 0
    for number in range(14):
        if number == 2:  # the episodes end in different steps from here on
            mask = np.array([False, True, False])
            assert same(*(env.reset(seed=[None, 9, None], options={"reset_mask": mask.copy()}) for env in (ours, theirs)))
        action = random.uniform(-1, 1, (3, 2))
        mine = ours.step(action)
        assert same(mine, theirs.step(action)), number
        ended = mine[2] | mine[3]
        ends += int(ended.sum())
        assert ("final_obs" in mine[4]) == (mode is AutoresetMode.SAME_STEP and ended.any())
        if mode is AutoresetMode.DISABLED and ended.any():
            with pytest.raises(TaskError, match=f"after the end of row .*{np.flatnonzero(ended)[0]}"):
                ours.step(action)
            seeds = [11 + row if over else None for row, over in enumerate(ended)]
            assert same(*(env.reset(seed=list(seeds), options={"reset_mask": ended.copy()}) for env in (ours, theirs)))
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
    options = {"num_envs": 3, "render_mode": "rgb_array", "action_repeat": 4, "width": 32, "height": 32}
    ours, theirs = gymnasium.make_vec(ID, **options), gymnasium.make_vec(ID, vectorization_mode="sync", **options)
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 3, 2))
    for envs in (ours, theirs):
        envs.reset(seed=3)
        envs.step(actions[0])
    for name in ("render", "observation_space", "action_space", "render_mode", "max_episode_steps"):
        mine, others = ours.call(name), theirs.call(name)
        assert len(mine) == 3
        assert all(same(one, other) if name == "render" else one == other for one, other in zip(mine, others, strict=True)), name
    assert ours.get_attr("max_episode_steps") == (250,) * 3
    one = gymnasium.make(ID, action_repeat=4).unwrapped
    assert same(one.restore(ours.call("snapshot")[1]), ours.step(actions[1])[0][1]) is False
    kept = ours.call("snapshot")[1]
    one.restore(kept)
    assert same(one.step(actions[2, 1])[0], ours.step(actions[2])[0][1])


def test_a_vector_is_made_by_default_and_by_module_name():
    envs = gymnasium.make_vec(f"wasp_cli.tasks.gym:{ID}", num_envs=2, render_mode="rgb_array")
    assert isinstance(envs, wasp_cli.tasks.gym_vector.TaskVectorEnv)
    envs.reset(seed=0)
    assert [picture.shape for picture in envs.render()] == [(256, 256, 3)] * 2
    assert gymnasium.make_vec(ID, num_envs=1).render() == (None,)


def test_results_of_a_vector_belong_to_the_caller():
    envs = gymnasium.make_vec(ID, num_envs=2, action_repeat=50)
    envs.reset(seed=0)
    first = envs.step(np.ones((2, 2)))
    kept = pickle.loads(pickle.dumps(first))
    envs.step(np.ones((2, 2)))
    assert same(first, kept)


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda envs: envs.step(np.zeros((3, 2))), r"shape \(3, 2\), expected \(2, 2\)"),
        (lambda envs: envs.step(np.full((2, 2), np.nan)), "not finite"),
        (lambda envs: envs.reset(seed=[1]), "num_envs=2 but got length=1"),
        (lambda envs: envs.reset(options={"reset_mask": np.zeros(2, bool)}), "at least one"),
        (lambda envs: envs.reset(options={"level": 2}), "no option 'level'"),
    ],
)
def test_a_vector_refuses_what_it_cannot_do(call, expected):
    envs = gymnasium.make_vec(ID, num_envs=2)
    envs.reset(seed=0)
    with pytest.raises((TaskError, UsageError, ValueError), match=expected):
        call(envs)


def test_a_task_may_be_named_again():
    env = gymnasium.make(ID, task="goal1")
    again = gymnasium.make(env.spec)
    assert same(env.reset(seed=2), again.reset(seed=2))
    assert wasp_cli.tasks.gym.TaskEnv("race1").max_episode_steps == 500


def test_a_vector_steps_after_a_reset_only_and_has_no_six_values():
    with pytest.raises(TaskError, match="reset"):
        gymnasium.make_vec(ID, num_envs=2).step(np.zeros((2, 2)))
    with pytest.raises(UsageError, match="no option 'upstream_api'"):
        gymnasium.make_vec(ID, num_envs=2, upstream_api=True)


@pytest.mark.parametrize(
    "make",
    [
        lambda: gymnasium.make(ID, upstream_api=True, action_repeat=10),
        lambda: wasp_cli.tasks.gym.upstream("SafetyPointGoal1-v0", action_repeat=10),
        lambda: wasp_cli.tasks.gym.upstream("goal1", action_repeat=10),
    ],
)
def test_upstream_api_gives_six_values_and_its_keys(make):
    env, usual = make(), gymnasium.make(ID, action_repeat=10)
    first, nothing = env.reset(seed=9)
    assert same(first, usual.reset(seed=9)[0])
    assert nothing == {"cost_hazards": 0.0, "cost_sum": 0.0}
    costs = 0.0
    for _ in range(100):
        action = np.array([1.0, 0.1])  # through a hazard
        observation, reward, cost, terminated, truncated, info = env.step(action)
        expected = usual.step(action)
        assert same(observation, expected[0])
        assert (reward, terminated, truncated) == expected[1:4]
        assert cost == info["cost_sum"] == expected[4]["cost"]
        assert info.keys() - {"goal_met"} == {"cost_sum", "cost_hazards"}
        costs += cost
    assert truncated
    assert costs > 0
    with pytest.raises(TaskError, match="after the end"):
        env.step(action)


def test_goal_met_is_there_in_steps_that_reach_a_goal_and_in_no_other(monkeypatch):
    env = wasp_cli.tasks.gym.upstream("SafetyPointGoal1-v0")
    env.reset(seed=0)
    assert "goal_met" not in env.step(np.zeros(2))[5]
    task = env.unwrapped._task
    real = task.step
    monkeypatch.setattr(task, "step", lambda action: real(action)._replace(goals=np.array([1])))
    assert env.step(np.zeros(2))[5]["goal_met"] is True


def test_upstream_names_what_it_does_not_know():
    with pytest.raises(UnknownName, match="SafetyPointGaol1-v0") as caught:
        wasp_cli.tasks.gym.upstream("SafetyPointGaol1-v0")
    assert "wasp/SafetyPointGoal1-v0" in caught.value.hint


@pytest.mark.parametrize("observation", ["state", "all"])
def test_an_environment_returns_to_a_pickled_snapshot_to_the_bit(observation):
    env, other = (gymnasium.make(ID, observation=observation, action_repeat=20).unwrapped for _ in range(2))
    env.reset(seed=3)
    other.reset(seed=4)
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    for action in actions[:15]:
        last = env.step(action)
    env._goals = 2  # counted in info, and part of what is kept
    kept = pickle.loads(pickle.dumps(env.snapshot()))
    assert all(isinstance(array, np.ndarray) for array in kept.values())
    future = [env.step(action) for action in actions[15:]]
    for again in (env, other):
        assert same(again.restore(kept), last[0])
        for action, expected in zip(actions[15:], future, strict=True):
            assert same(again.step(action), expected)
    with pytest.raises(TaskError, match="snapshot"):
        env.restore({"qpos": np.zeros(3)})


def test_actions_beyond_the_bounds_are_clipped():
    wild, tame = gymnasium.make(ID), gymnasium.make(ID)
    wild.reset(seed=0)
    tame.reset(seed=0)
    for _ in range(5):
        assert same(wild.step(np.array([7.0, -9.0]))[0], tame.step(np.array([1.0, -1.0]))[0])


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        (np.array([np.nan, 0.0]), "not finite"),
        (np.array([np.inf, 0.0]), "not finite"),
        (np.array([1.0, 1j]), "array of real numbers, not ndarray of complex128"),
        ([1.0, 1j], "array of real numbers, not list"),
        (["1", "0"], "array of real numbers, not list"),
        (np.zeros(3), r"shape \(3,\), expected \(2,\)"),
        (np.zeros((1, 2)), r"shape \(1, 2\), expected \(2,\)"),
        (0.5, r"shape \(\), expected"),
        ("forward", "array of real numbers, not str"),
        (None, "expected \\(2,\\)"),
    ],
    ids=str,
)
def test_wrong_actions_are_refused_and_change_nothing(action, expected):
    env = gymnasium.make(ID)
    env.reset(seed=0)
    before = env.unwrapped.snapshot()
    with pytest.raises(TaskError, match=expected):
        env.step(action)
    assert same(env.unwrapped.snapshot(), before)


@pytest.mark.parametrize(
    ("options", "expected", "hint"),
    [
        ({"observation": "pixel"}, "no observation 'pixel'", "'pixels'"),
        ({"observe": "pixels"}, "no option 'observe'", "'observation'"),
        ({"action_repeat": 0}, "action_repeat should be an integer of at least 1, not 0", None),
        ({"action_repeat": 2.5}, "not 2.5", None),
        ({"task": "race1"}, f"'{ID}' is the task 'goal1', and task='race1' cannot change it", "wasp/SafetyCarRace1-v0"),
        ({"task": 3}, "task=3 cannot change it", None),
        ({"render_mode": "rgb_array", "view": "chase"}, "no option 'view'", None),
    ],
)
def test_wrong_options_are_refused_with_a_suggestion(options, expected, hint):
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(UsageError, match=expected) as caught:
            make(ID, **options)
        # gymnasium.make raises TypeErrors anew, without hints: of an unknown option the message has it.
        assert hint is None or hint in (caught.value.hint or caught.value.message)


def test_wrong_resets_are_refused():
    env = gymnasium.make(ID)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    with pytest.raises(UsageError, match="no option 'level'"):
        env.reset(options={"level": 2})
    with pytest.raises(gymnasium.error.Error, match="greater or equal to zero"):
        env.reset(seed=-1)
    env.reset(seed=0, options={})


def test_a_seed_beyond_the_layouts_draws_one():
    """Minari seeds every reset without a seed with 64 bits."""
    env, again, envs = gymnasium.make(ID), gymnasium.make(ID), gymnasium.make_vec(ID, num_envs=2)
    for seed in (2**32, 2**64 - 1):
        first = env.reset(seed=seed)
        assert same(first, again.reset(seed=seed))
        assert not same(first, again.reset(seed=seed - 7 if seed > 2**33 else 0))
        assert same(envs.reset(seed=[seed, 0])[0][0], first[0])
        again.reset(seed=seed)
        second = env.reset()
        assert same(second, again.reset())
        assert not same(first, second)


@pytest.mark.parametrize("name", ["gaol1", "wasp/SafetyPointGaol1-v0", "SafetyPointGoal1"])
def test_an_unknown_task_is_named_with_close_ones(name):
    with pytest.raises(UnknownName, match=f"unknown task '{name}'") as caught:
        make_task(name, 1)
    assert "goal1" in caught.value.hint or "SafetyPointGoal1-v0" in caught.value.hint


def test_mujoco_that_does_not_import_is_an_expected_error():
    code = f"""
import gymnasium, pathlib, wasp_cli.tasks.gym, wasp_cli.tasks.sheet
from wasp_cli.errors import WaspError

for attempt in (
    lambda: gymnasium.make('{ID}'),
    lambda: gymnasium.make_vec('{ID}', num_envs=2),
    lambda: wasp_cli.tasks.sheet.draw_sheet('goal1', 0, 0, pathlib.Path('never.png')),
):
    try:
        attempt()
    except WaspError as error:
        print(error.exit_code, error.message, error.hint)
"""
    environment = {**os.environ, "MUJOCO_GL": "foo"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    told = done.stdout.splitlines()
    assert len(told) == 3, done.stderr
    assert all(line.startswith("2 MuJoCo does not import with MUJOCO_GL=foo") and "unset MUJOCO_GL" in line for line in told)


def test_a_backend_of_opengl_that_is_not_there_is_an_error_not_a_traceback():
    code = "from wasp_cli.tasks.make import make_task; make_task('goal1', 1, observe=())"
    environment = {**os.environ, "MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": ""}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    # Where OSMesa is installed it simply works.
    assert done.returncode == 0 or "UsageError: MuJoCo does not import with MUJOCO_GL=osmesa" in done.stderr
