"""Environments of others as a spec declares them: where image, vectors, cost and success are."""

import sys
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.tasks.lights import Lights, registered
from wasp_cli.errors import TaskError, UnknownName
from wasp_cli.tasks.base import VectorTask
from wasp_cli.tasks.declared import (
    Declaration,
    DeclarationError,
    declaration_of,
    declare,
    declare_from,
)
from wasp_cli.tasks.foreign.surroundings import go_headless
from wasp_cli.tasks.foreign.task import GymTask
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.references import reference
from wasp_cli.tasks.registry import TASKS, ForeignInfo

BOX, DICT = gymnasium.spaces.Box, gymnasium.spaces.Dict


class Beam(gymnasium.Env):
    """Its state is three numbers. It draws them as rows of grey, and counts how often."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    action_space: gymnasium.Space = BOX(-1.0, 1.0, (2,), np.float64)
    observation_space: gymnasium.Space = BOX(-np.inf, np.inf, (3,), np.float64)
    drawn = 0

    def __init__(self, render_mode=None, gain=1.0):
        self.render_mode, self.gain = render_mode, gain

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(0.2, 0.5, 3)
        self.last = None
        return self.seen(), {}

    def step(self, action):
        self.last = np.array(action)
        self.state = self.state + 0.01 * self.gain * np.sum(action) + self.np_random.normal(0, 0.01)
        return self.seen(), float(self.state[0]), bool(self.state[0] > 0.9), False, self.info()

    def seen(self) -> Any:
        return self.state.copy()

    def info(self) -> dict[str, Any]:
        low = bool(self.state[0] < 0.4)
        return {"crashed": low, "deep": {"force": np.array([2.0 * low])}, "label": "beam"}

    def render(self):
        assert self.render_mode == "rgb_array"
        type(self).drawn += 1
        grey = (255 * np.clip(self.state, 0, 1)).astype(np.uint8)
        return np.repeat(np.repeat(grey, 30)[:, None, None], 120, 1) + np.zeros((1, 1, 3), np.uint8)


def variant(**attributes: Any) -> type[Beam]:
    return type("Variant", (Beam,), attributes)


def declared(env: type[Any] = Beam, batch: int = 1, **said: Any) -> VectorTask:
    """A task of an environment that is declared under its own id, of which the cost is known."""
    name = registered(env)
    declare(name, Declaration(id=name, **{"cost": "info.crashed", **said}))
    return make_task(name, batch, action_repeat=1)


def driven(task: VectorTask, steps: int = 12) -> list[Any]:
    task.reset(list(range(task.batch)))
    random = np.random.default_rng(0)
    return [task.step(random.uniform(-1, 1, (task.batch, task.action_size))) for _ in range(steps)]


# -- names -----------------------------------------------------------------------------------------


def test_a_declared_name_means_its_environment_until_it_is_declared_again():
    name = registered(Beam)
    declare("my-beam", Declaration(id=name, cost="info.crashed", limit=7, seconds=0.5))
    info = TASKS["my-beam"]
    assert isinstance(info, ForeignInfo)
    assert (info.title, info.gym_id, info.env_steps, info.env_seconds) == ("my-beam", name, 7, 0.5)
    assert make_task("my-beam", 2, action_repeat=2).max_decisions == 4
    declare_from("my-beam", {"action_repeat": 4})
    assert declaration_of("my-beam") is None
    with pytest.raises(UnknownName, match="unknown task 'my-beam'"):
        TASKS["my-beam"]


def test_what_travels_is_enough_to_make_the_same_task_elsewhere():
    name = registered(Beam)
    said = Declaration(
        id=name, name="far", make={"gain": 0.5}, image="render", cost={"low": "info.crashed"}
    )
    declare("far", said)
    here = driven(make_task("far", 2, action_repeat=1))
    declare("far", None)
    declare_from("far", {"environment": said.plain()})
    there = driven(make_task("far", 2, action_repeat=1))
    for one, other in zip(here, there, strict=True):
        np.testing.assert_equal(one._asdict(), other._asdict())
    assert set(said.plain()) == {"id", "make", "image", "cost"}


def test_an_entry_that_says_no_more_than_the_id_is_the_id_alone():
    name = registered(Lights)
    declare(name, Declaration(id=name, action_repeat=2))
    assert declaration_of(name) is None


# -- image -----------------------------------------------------------------------------------------


def test_render_is_called_once_a_decision_and_only_where_images_are_looked_at():
    env = variant(drawn=0)
    name = registered(env)
    declare(name, Declaration(id=name, image="render", cost="info.crashed"))
    blind = make_task(name, 1, action_repeat=5, observe=("privileged",))
    env.drawn = 0
    blind.reset([0])
    blind.step(np.zeros((1, 2)))
    assert env.drawn == 0
    seeing = make_task(name, 1, action_repeat=5)
    seeing.reset([0])
    assert env.drawn == 1
    step = seeing.step(np.zeros((1, 2)))
    assert env.drawn == 2
    assert step.observation.pixels.shape == (1, 6, 64, 64)
    first = int(255 * step.observation.privileged[0, 0])
    assert abs(int(step.observation.pixels[0, 0, 0, 0]) - first) <= 1
    assert seeing.cameras == 1


def test_a_plain_vector_is_what_assistants_see_without_an_image():
    task = declared()
    assert (task.cameras, task.state_size, task.privileged_size) == (0, 3, 3)
    first = task.reset([0])
    assert first.pixels is None
    np.testing.assert_allclose(first.state, first.privileged, rtol=1e-6)


GREY = np.random.default_rng(0).integers(0, 256, (64, 64), np.uint8)
COLOUR = np.random.default_rng(1).integers(0, 256, (64, 64, 4), np.uint8)


@pytest.mark.parametrize(
    ("space", "image", "expected"),
    [
        (BOX(0, 255, (64, 64), np.uint8), GREY, np.stack([GREY] * 3)),
        (BOX(0, 255, (64, 64, 1), np.uint8), GREY[..., None], np.stack([GREY] * 3)),
        (BOX(0, 255, (1, 64, 64), np.uint8), GREY[None], np.stack([GREY] * 3)),
        (BOX(0, 1, (64, 64), np.float32), GREY / np.float32(255), np.stack([GREY] * 3)),
        (BOX(0, 255, (64, 64, 4), np.uint8), COLOUR, np.moveaxis(COLOUR[..., :3], -1, 0)),
        (BOX(0, 1, (64, 64, 3), np.float64), COLOUR[..., :3] / 255, np.moveaxis(COLOUR, -1, 0)[:3]),
    ],
    ids=["[H, W]", "[H, W, 1]", "[1, H, W]", "floats [H, W]", "RGBA", "floats"],
)
def test_images_of_other_forms_are_seen_as_they_are(space, image, expected):
    whole = variant(observation_space=space, seen=lambda self: image)
    seen = declared(whole, image="observation").reset([0]).pixels
    np.testing.assert_array_equal(seen[0, :3], expected)
    parts = variant(
        observation_space=DICT(eye=DICT(left=space), speed=BOX(-9, 9, (1,))),
        seen=lambda self: {"eye": {"left": image}, "speed": self.state[:1]},
    )
    task = declared(parts, image="eye.left", state=["speed"])
    np.testing.assert_array_equal(task.reset([0]).pixels[0, :3], expected)
    assert task.privileged_size == 1


@pytest.mark.parametrize("shape", [(4, 84, 84), (2, 64, 64, 3), (64, 64, 9)])
def test_a_stack_of_frames_is_refused_with_what_to_do(shape):
    space = BOX(0, 255, shape, np.uint8)
    env = variant(observation_space=space, seen=lambda self: np.zeros(shape, np.uint8))
    with pytest.raises(DeclarationError) as caught:
        declared(env, image="observation")
    assert caught.value.field == "image"
    assert "take the stack of frames off" in str(caught.value.hint)


def test_floats_beyond_one_are_no_image():
    env = variant(
        observation_space=BOX(0, 1, (64, 64), np.float32),
        seen=lambda self: np.full((64, 64), 2.0, np.float32),
    )
    with pytest.raises(TaskError, match="values from 2 to 2"):
        declared(env, image="observation")


def test_an_environment_that_shows_nothing_is_told_of_render():
    env = variant(observation_space=gymnasium.spaces.Text(5), seen=lambda self: "beam")
    with pytest.raises(TaskError, match="neither a camera image nor a vector") as caught:
        declared(env)
    assert "image: render" in str(caught.value.hint)


# -- vectors ---------------------------------------------------------------------------------------

GOALS = DICT(
    observation=BOX(-9, 9, (2,)),
    desired_goal=BOX(-9, 9, (2, 2)),
    more=DICT(mode=gymnasium.spaces.Discrete(3, start=1), word=gymnasium.spaces.Text(9)),
)


def goals(env: Beam) -> dict[str, Any]:
    return {
        "observation": np.array([1.0, 2.0], np.float32),
        "desired_goal": np.array([[3.0, 4.0], [5.0, 6.0]], np.float32),
        "more": {"mode": 2, "word": "beam"},
    }


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (None, [3, 4, 5, 6, 0, 1, 0, 1, 2]),
        ("observation", [3, 4, 5, 6, 0, 1, 0, 1, 2]),
        (["observation", "desired_goal"], [1, 2, 3, 4, 5, 6]),
        (["more.mode"], [0, 1, 0]),
    ],
)
def test_dictionaries_are_one_vector_in_a_fixed_order(state, expected):
    task = declared(variant(observation_space=GOALS, seen=goals), state=state)
    np.testing.assert_array_equal(task.reset([0]).state, [expected])


@pytest.mark.parametrize(
    ("state", "message"),
    [(["speed"], "no entry 'speed'"), (["more.word"], "has no numbers")],
)
def test_an_entry_that_is_no_vector_is_named_with_those_that_are_there(state, message):
    with pytest.raises(DeclarationError, match=message) as caught:
        declared(variant(observation_space=GOALS, seen=goals), state=state)
    assert caught.value.field == "state"
    assert "more.mode" in str(caught.value.hint)


# -- cost and success ------------------------------------------------------------------------------

FUNCTIONS = """
def low(env, action, info):
    return env.unwrapped.state[0] < 0.4

def pushed(env, action, info):
    return abs(action).sum()

def lost(env, action, info):
    return None

def places(env):
    return [*env.unwrapped.state, 7.0]

def nowhere(env):
    return [float("nan")]
"""


@pytest.fixture
def functions(tmp_path, monkeypatch) -> str:
    (tmp_path / "beam_costs.py").write_text(FUNCTIONS, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "beam_costs", raising=False)
    return "beam_costs"


def costs(task: VectorTask) -> list[int]:
    return [int(step.cost_env[0]) for step in driven(task)]


def test_every_way_to_say_where_the_cost_is_says_the_same(functions):
    expected = costs(declared(cost="info.crashed"))
    assert 0 < sum(expected) < len(expected)
    for where in ("info.deep.force", f"{functions}:low"):
        assert costs(declared(cost=where)) == expected
    several = declared(cost={"low": f"{functions}:low", "push": f"{functions}:pushed"})
    assert several.cost_sources == ("low", "push")
    steps = driven(several)
    assert [int(step.sources["low"][0]) for step in steps] == expected
    assert all(step.cost_env[0] == 1 for step in steps)


def test_the_end_of_an_episode_may_cost():
    task = declared(cost="terminated", make={"gain": 5.0})
    task.reset([0])
    paid, ended = [], False
    while not ended:
        step = task.step(np.ones((1, 2)))
        paid.append(int(step.cost_env[0]))
        ended = bool(step.ended[0])
    assert step.terminated[0]
    assert paid == [0] * (len(paid) - 1) + [1]


@pytest.mark.parametrize(
    "said", [{"cost": "beam_costs:low"}, {"cost": "info.crashed", "state": "beam_costs:places"}]
)
def test_a_function_is_in_the_key_of_results(said, functions):
    name = registered(Beam)
    declare(name, Declaration(id=name, **said))
    assert functions in TASKS[name].modules


IMAGE_ALONE = {
    "observation_space": BOX(0, 255, (64, 64, 3), np.uint8),
    "seen": lambda self: np.full((64, 64, 3), int(200 * self.state[0]), np.uint8),
}


def test_a_function_may_measure_what_the_expert_reads_beside_an_image(functions):
    for image in (None, "observation"):
        task = declared(variant(**IMAGE_ALONE), state=f"{functions}:places", image=image)
        seen = task.reset([0])
        assert (task.cameras, task.privileged_size) == (1, 4)
        state = seen.privileged[0]
        assert state[3] == 7.0
        assert seen.pixels[0, 0, 0, 0] == int(200 * state[0])
        after = task.step(np.zeros((1, 2))).observation
        assert after.privileged[0, 0] != state[0]
        assert after.pixels[0, 0, 0, 0] == int(200 * after.privileged[0, 0])


def test_a_function_may_measure_what_assistants_see_without_an_image(functions):
    task = declared(state=f"{functions}:places", image="none")
    seen = task.reset([0])
    assert seen.pixels is None
    np.testing.assert_allclose(seen.state, seen.privileged)
    assert seen.state.shape == (1, 4)


@pytest.mark.parametrize(
    ("said", "field", "message"),
    [
        ({"cost": "info.crash"}, "cost", "no info.crash: info has crashed, deep, label"),
        ({"cost": "info.deep.speed"}, "cost", "info.deep has force"),
        ({"cost": "info.label"}, "cost", "info.label is 'beam'"),
        ({"cost": "beam_costs:lost"}, "cost", "beam_costs:lost is None"),
        ({"cost": "beam_costs:nobody"}, "cost", "no function 'nobody'"),
        ({"cost": "no_such_module:f"}, "cost", "no_such_module"),
        ({"success": "info.won"}, "success", "no info.won"),
        ({"state": "beam_costs:nobody"}, "state", "no function 'nobody'"),
        ({"state": "beam_costs:nowhere"}, "state", "beam_costs:nowhere is [nan]"),
        ({"image": "camera"}, "image", "no entry 'camera'"),
        ({"make": {"gian": 1}}, "make", "gian"),
    ],
)
def test_a_line_that_is_wrong_is_named(said, field, message, functions):
    with pytest.raises(DeclarationError) as caught:
        declared(**said)
    assert caught.value.field == field
    assert message in caught.value.message
    assert caught.value.hint


def test_arguments_of_make_reach_the_environment():
    slow, fast = (driven(declared(make={"gain": gain})) for gain in (1.0, 5.0))
    assert not np.array_equal(slow[-1].observation.state, fast[-1].observation.state)


def test_success_is_read_where_it_is():
    task = declared(success="info.crashed")
    expected = costs(declared(cost="info.crashed"))
    goals = [int(step.goals[0]) for step in driven(task)]
    assert sum(goals) == 1
    assert goals.index(1) == expected.index(1)


def test_the_cost_may_be_the_third_of_six_values():
    def step(self, action):
        seen, reward, terminated, truncated, info = Beam.step(self, action)
        return seen, reward, float(info["crashed"]), terminated, truncated, {}

    assert costs(declared(variant(step=step), cost=None)) == costs(declared())


NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,8}", fullmatch=True)


@given(st.lists(NAMES, min_size=1, max_size=4), NAMES)
def test_a_reference_is_read_as_it_is_written(path, function):
    read = reference("info." + ".".join(path))
    assert (read.path, read.module, read.function) == (tuple(path), "", "")
    read = reference(".".join(path) + ":" + function)
    assert (read.path, read.module, read.function) == ((), ".".join(path), function)


@given(st.text(max_size=20))
def test_any_other_text_is_no_reference(text):
    written = text == "terminated" or text.startswith("info.") or ":" in text
    if not written:
        with pytest.raises(TaskError, match="does not say where"):
            reference(text)


# -- actions ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "command", "got"),
    [
        (BOX(0.0, 3.0, (1,), np.float32), [0.0], [1.5]),
        (BOX(-1.0, 1.0, (5,), np.float64), [0.1, 0.2, 0.3, 0.4, 0.5], [0.1, 0.2, 0.3, 0.4, 0.5]),
        (BOX(0, 10, (2,), np.int64), [-0.9, 0.31], [0, 7]),
        (BOX(-2.0, 4.0, (2, 1), np.float64), [-1.0, 1.0], [[-2.0], [4.0]]),
    ],
    ids=["one", "five", "whole numbers", "a matrix"],
)
def test_actions_of_any_finite_bounds(space, command, got):
    task = declared(variant(action_space=space))
    task.reset([0])
    task.step(np.array([command]))
    last = task._envs[0].unwrapped.last
    assert last.dtype == space.dtype
    np.testing.assert_allclose(last, got, atol=1e-7)


@pytest.mark.parametrize(
    ("space", "hint"),
    [
        (gymnasium.spaces.Discrete(3), "continuous: true"),
        (gymnasium.spaces.MultiDiscrete([3, 2]), "continuous: true"),
        (BOX(-np.inf, np.inf, (2,)), "RescaleAction"),
        (BOX(np.finfo(np.float32).min, np.finfo(np.float32).max, (2,)), "RescaleAction"),
    ],
)
def test_actions_that_are_no_commands_are_refused_with_what_to_do(space, hint):
    with pytest.raises(TaskError, match="its action space is") as caught:
        declared(variant(action_space=space))
    assert hint in str(caught.value.hint)


# -- snapshots -------------------------------------------------------------------------------------


def test_an_environment_without_snapshots_is_played_again():
    task = declared(batch=3, image="render")
    random = np.random.default_rng(1)
    actions = random.uniform(-1, 1, (12, 3, 2))
    task.reset([4, 5, 6])
    for action in actions[:5]:
        task.step(action)
    kept = task.snapshot()
    assert all(len(array) == 3 for array in kept.values())
    went_on = [task.step(action) for action in actions[5:]]
    seen = task.restore(kept)
    again = [task.step(action) for action in actions[5:]]
    np.testing.assert_array_equal(seen.state, kept["state"])
    for one, other in zip(went_on, again, strict=True):
        np.testing.assert_equal(one._asdict(), other._asdict())


def test_rows_of_earlier_and_later_snapshots_fit_together():
    task = declared(batch=2)
    task.reset([4, 5])
    early = task.snapshot()
    actions = np.random.default_rng(1).uniform(-1, 1, (8, 2, 2))
    for action in actions[:4]:
        task.step(action)
    late = task.snapshot()
    mixed = {name: np.stack([early[name][0], late[name][1]]) for name in early}
    task.restore(mixed)
    step = task.step(actions[4])
    alone = declared(batch=2)
    alone.reset([4, 5])
    begun = alone.step(actions[4]).observation.state[0]
    np.testing.assert_array_equal(step.observation.state[0], begun)
    task.restore(late)
    np.testing.assert_array_equal(
        task.step(actions[4]).observation.state[1], step.observation.state[1]
    )


def test_seeds_that_are_not_honest_are_named_when_an_earlier_step_is_returned_to():
    """Its first steps follow the seed, so that it passes when it is made."""

    def step(self, action):
        self.count = getattr(self, "count", 0) + 1
        done = list(Beam.step(self, action))
        if self.count > 30:  # counted over episodes
            self.state = self.state + 1e-3 * self.count
            done[0] = self.seen()
        return tuple(done)

    task = declared(variant(step=step))
    assert isinstance(task, GymTask)
    task.reset([0])
    for _ in range(18):
        task.step(np.zeros((1, 2)))
    kept = task.snapshot()
    task.restore(kept)
    with pytest.raises(TaskError, match="seed 0 and the same 18 actions lead to another") as caught:
        task.step(np.zeros((1, 2)))
    assert "np_random" in str(caught.value.hint)


# -- environments of gymnasium ---------------------------------------------------------------------


@pytest.mark.skipif(find_spec("pygame") is None, reason="it draws with pygame")
def test_pendulum_as_it_is():
    declare("swing", Declaration(id="Pendulum-v1", cost="terminated", image="render"))
    task = make_task("swing", 2, action_repeat=2)
    assert (task.action_size, task.state_size, task.max_decisions) == (1, 3, 100)
    steps = driven(task, 4)
    assert steps[-1].observation.pixels.std() > 1


@pytest.mark.skipif(find_spec("Box2D") is None, reason="it needs box2d")
def test_lunar_lander_as_it_is():
    go_headless()
    said = Declaration(id="LunarLander-v3", make={"continuous": True}, cost="terminated")
    declare("lander", said)
    task = make_task("lander", 2, action_repeat=4)
    assert (task.action_size, task.cameras, task.state_size) == (2, 0, 8)
    driven(task, 3)
