"""Environments of others that lack something or fail: one clear error each, and what is forgiven."""

import re
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.tasks.lights import Lights, registered
from wasp_cli.errors import TaskError, UnknownName
from wasp_cli.tasks.foreign.examine import examine
from wasp_cli.tasks.foreign.task import GymTask
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS

BOX = gymnasium.spaces.Box


def variant(**attributes: Any) -> type[Lights]:
    return type("Variant", (Lights,), attributes)


@pytest.mark.parametrize(
    ("env", "options", "expected"),
    [
        (variant(info=lambda self: {}), {}, r"its info has no 'cost'.*info\['cost'\]"),
        (variant(info=lambda self: {"cost": float("nan")}), {}, r"info\['cost'\] is nan"),
        (variant(info=lambda self: {"cost": 0.0, "cost_sources": ["wet"]}), {}, r"info\['cost_sources'\] is \['wet'\]"),
        (variant(), {"max_episode_steps": None}, "no time limit.*max_episode_steps=500"),
        (variant(metadata={"render_modes": []}), {}, "how long an env step is.*render_fps"),
        (variant(action_space=BOX(-np.inf, np.inf, (2,))), {}, "finite lower bound"),
        (variant(observation_space=gymnasium.spaces.Dict(view=BOX(0, 255, (64, 64, 3), np.uint8))), {}, r"no camera image: Dict\(view"),
        (variant(seen=lambda self: np.random.default_rng().integers(0, 255, (64, 64, 3), np.uint8)), {}, "two resets with the same seed"),
        (variant(__init__=lambda self: 1 / 0), {}, "cannot be made: ZeroDivisionError"),
        (variant(metadata={"render_modes": [], "render_fps": 25, "success_goals": "a"}), {}, r"metadata\['success_goals'\] is 'a'"),
    ],
)
def test_what_an_environment_lacks_is_named_with_a_remedy(env, options, expected):
    name = registered(env, **options)
    with pytest.raises(TaskError) as caught:
        make_task(name, 1)
    assert name in caught.value.message
    assert re.search(expected, f"{caught.value.message} {caught.value.hint}"), caught.value


def stepping(step: Any) -> type[Lights]:
    """An environment whose step returns what `step` makes of the usual five values."""
    return variant(step=lambda self, action: step(*Lights.step(self, action)))


def informing(**told: Any) -> type[Lights]:
    return variant(info=lambda self: {"cost": 0.0, **told})


def showing(seen: Any) -> type[Lights]:
    return variant(seen=lambda self: seen)


def failing(*_: Any) -> Any:
    raise RuntimeError("the wheel\nfell off")


FAILING: list[tuple[type[Lights], str]] = [
    (variant(step=failing), "its step failed: RuntimeError: the wheel fell off .*in test_foreign_errors.py, line"),
    (variant(step=lambda self, action: sys.exit(7)), "its step failed: SystemExit: 7"),
    (variant(reset=lambda self, **_: 1 / 0), "its reset failed: ZeroDivisionError"),
    (variant(reset=lambda self, **_: Lights.reset(self)[0]), r"its reset returned a single ndarray.*\(observation, info\)"),
    (variant(reset=lambda self, **_: (Lights.reset(self)[0], None)), "its reset returned None as info"),
    (stepping(lambda seen, reward, over, cut, info: (seen, reward, over, info)), "its step returned 4 values.*terminated, truncated"),
    (stepping(lambda *five: (*five[:4], None)), "its step returned None as info"),
    (stepping(lambda seen, reward, *rest: (seen, None, *rest)), "its step gave a reward of None"),
    (stepping(lambda seen, reward, over, *rest: (seen, reward, None, *rest)), "its step gave terminated = None"),
    (informing(cost="x"), r"info\['cost'\] is 'x'"),
    (informing(cost=float("inf")), r"info\['cost'\] is inf"),
    (informing(cost_sources={"wet": "x"}), r"info\['cost_sources'\]\['wet'\] is 'x'"),
    (informing(goals=0.5), r"info\['goals'\] is 0.5"),
    (informing(success=np.zeros(2)), r"info\['success'\] = array"),
    (showing(np.zeros((64, 64, 3))), r"its observation is float64 of shape \(64, 64, 3\), not uint8"),
]
SPACE = gymnasium.spaces.Dict(image=BOX(0, 255, (64, 64, 3), np.uint8), state=BOX(-1, 1, (2,)))
IMAGE = np.zeros((64, 64, 3), np.uint8)
for seen, expected in (
    (IMAGE, "its observation has no 'image': ndarray"),
    ({"image": IMAGE}, r"its observation has no 'state': entries \['image'\]"),
    ({"image": IMAGE, "state": np.zeros(3)}, "its observation 'state' has 3 values, its space has 2"),
    ({"image": IMAGE, "state": [0.0, float("inf")]}, "its observation 'state' is not finite"),
):
    FAILING.append((type("Variant", (Lights,), {"observation_space": SPACE, "seen": lambda self, seen=seen: seen}), expected))


@pytest.mark.parametrize(("env", "expected"), FAILING, ids=[expected for _, expected in FAILING])
def test_an_environment_that_fails_is_one_clear_error(env, expected):
    name = registered(env)
    with pytest.raises(TaskError) as caught:
        examine(name)
    assert caught.value.message.startswith(f"environment '{name}': its ") or f"'{name}': info[" in caught.value.message
    assert re.search(expected, f"{caught.value.message} {caught.value.hint}"), caught.value


@pytest.mark.parametrize(("env", "expected"), FAILING, ids=[expected for _, expected in FAILING])
def test_one_that_fails_in_the_middle_of_an_episode_too(env, expected):
    sound = type("Sound", (Lights,), {"observation_space": env.observation_space})
    if isinstance(env.observation_space, gymnasium.spaces.Dict):
        sound.seen = lambda self: {"image": IMAGE, "state": np.zeros(2)}
    name = registered(sound)
    task = make_task(name, 1)
    task.reset([0])
    task._envs[0].unwrapped.__class__ = env
    # What fails in reset alone shows in the next episode.
    call = (lambda: task.reset([0])) if "reset" in env.__dict__ else (lambda: task.step(np.zeros((1, 2))))
    with pytest.raises(TaskError, match=f"environment '{name}': ") as caught:
        call()
    assert re.search(expected, f"{caught.value.message} {caught.value.hint}"), caught.value


def test_numbers_may_be_of_every_real_type():
    told = {"cost": np.float32(1), "cost_sources": {"wet": np.array(1), "dry": False}, "goals": np.int64(2), "success": np.True_}
    env = type("Typed", (stepping(lambda seen, reward, *rest: (seen, np.array(0.5), *rest)),), {"info": lambda self: told})
    task = make_task(registered(env), 1)
    task.reset([0])
    step = task.step(np.zeros((1, 2)))
    assert (step.reward[0], step.cost_env[0], step.goals[0]) == (2.0, 4, 2)
    assert {name: count[0] for name, count in step.sources.items()} == {"wet": 4, "dry": 0}


@pytest.mark.parametrize(
    ("name", "error", "expected"),
    [
        ("nowhere_at_all:MyEnv-v0", TaskError, "module 'nowhere_at_all' does not import.*pip install -e"),
        ("puddle:Pudle-v0", UnknownName, "module 'puddle' registers no 'Pudle-v0'.*did you mean 'Puddle-v0'"),
        ("json:MyEnv-v0", UnknownName, r"module 'json' registers no 'MyEnv-v0'.*gymnasium.register\('MyEnv-v0'"),
        ("NoSuchEnv-v7", UnknownName, "no gymnasium id is called 'NoSuchEnv-v7'.*module:NoSuchEnv-v7"),
        ("SafetyPointGoal3-v0", UnknownName, "did you mean .*'wasp/SafetyPointGoal1-v0'"),
        ("Race1-v0", UnknownName, "did you mean .*'race1'"),
    ],
)
def test_ids_that_lead_nowhere(name, error, expected):
    with pytest.raises(error) as caught:
        make_task(name, 1)
    assert re.search(expected, f"{caught.value.message} {caught.value.hint}"), caught.value


def test_an_environment_that_keeps_its_own_time_limit_may_say_so():
    name = registered(variant(max_episode_steps=13), max_episode_steps=None)
    assert TASKS[name].env_steps == 13
    assert GymTask(name, 1, action_repeat=5).max_decisions == 3


def test_facts_and_modules_say_what_moves_results():
    info = TASKS["puddle:Puddle-v0"]
    assert info.modules == ("wasp_cli.tasks.foreign.task", "puddle")
    facts = info.facts()
    assert (facts["env_seconds"], facts["env_steps"], facts["success_goals"], facts["registered"]) == (0.1, 200, 1, "[] []")
    assert "Puddle-v0" not in facts.values(), "titles move nothing"
    asked = registered(variant(metadata={"render_modes": [], "render_fps": 10, "success_goals": 4}))
    assert TASKS[asked].success_goals == 4
