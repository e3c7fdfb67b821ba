"""Gymnasium environments of others as tasks: what the adapter makes of them."""

import re
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.tasks.lights import Lights, registered
from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import Observation
from wasp_cli.tasks.foreign.examine import examine
from wasp_cli.tasks.foreign.task import GymTask
from wasp_cli.tasks.foreign.views import views_of
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS, is_foreign

BOX = gymnasium.spaces.Box


def variant(**attributes: Any) -> type[Lights]:
    return type("Variant", (Lights,), attributes)


def test_our_own_task_through_gymnasium_is_the_task_itself_to_the_bit():
    name = registered(
        "wasp_cli.tasks.gym:TaskEnv",
        kwargs={"task": "goal1", "observation": "all"},
        max_episode_steps=1000,
    )
    native, through = (make_task(one, 1, action_repeat=20) for one in ("goal1", name))
    assert isinstance(through, GymTask)
    for facts in (
        "decision_seconds",
        "max_decisions",
        "cost_sources",
        "state_size",
        "privileged_size",
        "action_size",
    ):
        assert getattr(through, facts) == getattr(native, facts)

    def flat(result: Any) -> list[Any]:
        return [flat(part) if isinstance(part, tuple) else part for part in result]

    seeds = [9]  # straight on, there are hazards
    np.testing.assert_equal(flat(through.reset(seeds)), flat(native.reset(seeds)))
    random, cost = np.random.default_rng(0), 0
    for _ in range(50):
        action = np.array([[1.0, 0.1]]) + random.normal(0, 0.02, (1, 2))
        ours, theirs = through.step(action), native.step(action)
        # The privileged vector holds the mean turn over a decision step, of which the environment
        # sees the last env step.
        ours, theirs = (
            step._replace(observation=step.observation._replace(privileged=None))
            for step in (ours, theirs)
        )
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
    space = BOX(-0.1, 0.1, (2, 3), np.float32)
    task = GymTask(registered(variant(action_space=space)), 1)
    assert task.action_size == 6
    task.reset([0])
    task.step(np.linspace(-1, 1, 6)[None])
    action = task._envs[0].unwrapped.got[0]
    assert (action.shape, action.dtype) == ((2, 3), np.float32)
    assert space.contains(action)
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
    assert [(step.ended[0], step.terminated[0]) for step in steps] == [
        (False, False),
        (False, False),
        (True, False),
    ]
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
    task = GymTask(registered(variant(info=lambda self: Lights.info(self) | told(self.clock))), 1)
    for _ in range(2):  # a new episode counts from nothing
        task.reset([0])
        assert [task.step(np.zeros((1, 2))).goals[0] for _ in range(3)] == expected


@pytest.mark.parametrize(
    ("costs", "sources"),
    [
        # as in Safety-Gymnasium
        ({"cost_sum": 1.0, "cost_wet": 1.0, "cost_cold": 0.0}, ("wet", "cold")),
        ({"cost_sum": 1.0}, ("cost",)),
        ({"cost_limit": 25.0}, ("cost",)),  # a number like another
    ],
)
def test_costs_may_be_told_flat(costs, sources):
    task = GymTask(registered(variant(info=lambda self: {"cost": 1.0, **costs})), 1)
    task.reset([0])
    step = task.step(np.zeros((1, 2)))
    assert task.cost_sources == sources
    assert {name: int(count[0]) for name, count in step.sources.items()} == {
        name: 4 * (name != "cold") for name in sources
    }


RANDOM = np.random.default_rng(0).integers(0, 256, (64, 64, 6), np.uint8)


@pytest.mark.parametrize(
    ("space", "observation", "rear"),
    [
        (BOX(0, 255, (64, 64, 3), np.uint8), RANDOM[..., :3], False),
        (BOX(0, 255, (3, 64, 64), np.uint8), np.moveaxis(RANDOM[..., :3], -1, 0), False),
        (BOX(0, 255, (64, 64, 6), np.uint8), RANDOM, True),
        (BOX(0, 255, (6, 64, 64), np.uint8), np.moveaxis(RANDOM, -1, 0), True),
        (
            gymnasium.spaces.Dict(vision=BOX(0, 255, (64, 64, 3), np.uint8)),
            {"vision": RANDOM[..., :3]},
            False,
        ),
        (
            gymnasium.spaces.Dict(
                image=BOX(0, 255, (64, 64, 3), np.uint8), image2=BOX(0, 255, (3, 64, 64), np.uint8)
            ),
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
    np.testing.assert_array_equal(views.pixels(observation, Lights()), expected)
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


@pytest.mark.parametrize(
    ("entries", "privileged", "state"),
    [(("privileged", "state"), 5, 7), (("privileged",), 5, 5), (("state",), 7, 7)],
)
def test_vectors_of_a_dictionary_are_taken_by_name(entries, privileged, state):
    sizes = {"privileged": 5, "state": 7}
    spaces = {"image": BOX(0, 255, (64, 64, 3), np.uint8)} | {
        name: BOX(-np.inf, np.inf, (sizes[name],), np.float64) for name in entries
    }

    def seen(env: Lights) -> dict[str, Any]:
        return {"image": Lights.seen(env)} | {
            name: np.full(sizes[name], sizes[name] + env.clock, float) for name in entries
        }

    task = GymTask(
        registered(variant(observation_space=gymnasium.spaces.Dict(spaces), seen=seen)), 1
    )
    assert (task.privileged_size, task.state_size) == (privileged, state)
    first: Observation = task.reset([0])
    np.testing.assert_array_equal(first.privileged, np.full((1, privileged), privileged))
    np.testing.assert_array_equal(first.state, np.full((1, state), state))


def test_a_snapshot_of_another_task_is_refused():
    other = make_task("puddle:Puddle-v0", 1)
    other.reset([0])
    with pytest.raises(TaskError, match="not one of this task"):
        other.restore({"goals": np.zeros(5)})


@pytest.mark.parametrize(
    "name", ["my_pkg:MyEnv-v0", "my.pkg:space/My-Env-v12", "MyEnv-v0", "space/MyEnv", "pkg:MyEnv"]
)
def test_gymnasium_ids_are_names_of_tasks(name):
    assert is_foreign(name)
    info = TASKS[name]
    assert (info.name, info.title) == (name, name.rpartition(":")[2])
    assert name not in list(TASKS)


# Environments of others that lack something or fail: one clear error each, and what is forgiven.


@pytest.mark.parametrize(
    ("env", "options", "expected"),
    [
        (variant(info=lambda self: {}), {}, r"its info has no 'cost'.*info\['cost'\]"),
        (variant(info=lambda self: {"cost": float("nan")}), {}, r"info\['cost'\] is nan"),
        (
            variant(info=lambda self: {"cost": 0.0, "cost_sources": ["wet"]}),
            {},
            r"info\['cost_sources'\] is \['wet'\]",
        ),
        (variant(), {"max_episode_steps": None}, "no time limit.*max_episode_steps=500"),
        (variant(metadata={"render_modes": []}), {}, "how long an env step is.*render_fps"),
        (variant(action_space=BOX(-np.inf, np.inf, (2,))), {}, "finite lower bound"),
        (
            variant(
                observation_space=gymnasium.spaces.Dict(view=BOX(0, 255, (64, 64, 3), np.uint8))
            ),
            {},
            r"neither a camera image nor a vector: .*Dict\(view.*image: view",
        ),
        (
            variant(
                seen=lambda self: np.random.default_rng().integers(0, 255, (64, 64, 3), np.uint8)
            ),
            {},
            "same seed and actions give another episode",
        ),
        (variant(__init__=lambda self: 1 / 0), {}, "cannot be made: ZeroDivisionError"),
        (
            variant(metadata={"render_modes": [], "render_fps": 25, "success_goals": "a"}),
            {},
            r"metadata\['success_goals'\] is 'a'",
        ),
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


def failing(*_: Any) -> Any:
    raise RuntimeError("the wheel\nfell off")


FAILING: list[tuple[type[Lights], str]] = [
    (
        variant(step=failing),
        "its step failed: RuntimeError: the wheel fell off .*in test_foreign.py, line",
    ),
    (variant(step=lambda self, action: sys.exit(7)), "its step failed: SystemExit: 7"),
    (variant(reset=lambda self, **_: 1 / 0), "its reset failed: ZeroDivisionError"),
    (
        variant(reset=lambda self, **_: Lights.reset(self)[0]),
        r"its reset returned a single ndarray.*\(observation, info\)",
    ),
    (
        variant(reset=lambda self, **_: (Lights.reset(self)[0], None)),
        "its reset returned None as info",
    ),
    (
        stepping(lambda seen, reward, over, cut, info: (seen, reward, over, info)),
        "its step returned 4 values.*terminated, truncated",
    ),
    (stepping(lambda *five: (*five[:4], None)), "its step returned None as info"),
    (stepping(lambda seen, reward, *rest: (seen, None, *rest)), "its step gave a reward of None"),
    (
        stepping(lambda seen, reward, over, *rest: (seen, reward, None, *rest)),
        "its step gave terminated = None",
    ),
    (informing(cost="x"), r"info\['cost'\] is 'x'"),
    (informing(cost=float("inf")), r"info\['cost'\] is inf"),
    (informing(cost_sources={"wet": "x"}), r"info\['cost_sources'\]\['wet'\] is 'x'"),
    (informing(goals=0.5), r"info\['goals'\] is 0.5"),
    (informing(success=np.zeros(2)), r"info\['success'\] = array"),
    (
        variant(seen=lambda self: np.zeros((64, 64, 3))),
        r"its observation is float64 of shape \(64, 64, 3\), not uint8",
    ),
]
SPACE = gymnasium.spaces.Dict(image=BOX(0, 255, (64, 64, 3), np.uint8), state=BOX(-1, 1, (2,)))
IMAGE = np.zeros((64, 64, 3), np.uint8)
for seen, expected in (
    (IMAGE, "its observation has no 'image': ndarray"),
    ({"image": IMAGE}, r"its observation has no 'state': entries \['image'\]"),
    (
        {"image": IMAGE, "state": np.zeros(3)},
        "its observation 'state' has 3 values, its space has 2",
    ),
    ({"image": IMAGE, "state": [0.0, float("inf")]}, "its observation 'state' is not finite"),
):
    FAILING.append(
        (
            type(
                "Variant",
                (Lights,),
                {"observation_space": SPACE, "seen": lambda self, seen=seen: seen},
            ),
            expected,
        )
    )


@pytest.mark.parametrize(("env", "expected"), FAILING, ids=[expected for _, expected in FAILING])
def test_an_environment_that_fails_is_one_clear_error(env, expected):
    name = registered(env)
    with pytest.raises(TaskError) as caught:
        examine(name)
    assert (
        caught.value.message.startswith(f"environment '{name}': its ")
        or f"'{name}': info[" in caught.value.message
    )
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
    call = (
        (lambda: task.reset([0]))
        if "reset" in env.__dict__
        else (lambda: task.step(np.zeros((1, 2))))
    )
    with pytest.raises(TaskError, match=f"environment '{name}': ") as caught:
        call()
    assert re.search(expected, f"{caught.value.message} {caught.value.hint}"), caught.value


def test_an_environment_that_keeps_its_own_time_limit_may_say_so():
    name = registered(variant(max_episode_steps=13), max_episode_steps=None)
    assert TASKS[name].env_steps == 13
    assert GymTask(name, 1, action_repeat=5).max_decisions == 3


def test_facts_and_modules_say_what_moves_results():
    info = TASKS["puddle:Puddle-v0"]
    assert info.modules == ("wasp_cli.tasks.foreign.processes", "puddle")
    facts = info.facts()
    assert (
        facts["env_seconds"],
        facts["env_steps"],
        facts["success_goals"],
        facts["registered"],
    ) == (0.1, 200, 1, "[] []")
    assert "Puddle-v0" not in facts.values(), "titles move nothing"
    asked = registered(variant(metadata={"render_modes": [], "render_fps": 10, "success_goals": 4}))
    assert TASKS[asked].success_goals == 4
    scaled = [
        gymnasium.wrappers.TransformReward.wrapper_spec(func=lambda reward: reward)
        for _ in range(2)
    ]
    one, other = (
        TASKS[registered(Lights, additional_wrappers=(each,))].facts()["registered"]
        for each in scaled
    )
    assert one == other, "a function has another address in every process"
