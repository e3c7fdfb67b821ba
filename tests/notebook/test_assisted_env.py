"""`wasp_cli.AssistedEnv`: gymnasium's and stable-baselines3's checkers pass it, and its episodes
are those of `wasp run`, in a task of ours and in somebody else's environment.
"""

import pickle
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from puddle import Puddle
from stable_baselines3.common.env_checker import check_env as check_with_baselines

import wasp_cli
from tests.notebook.assistants import (
    PUBLISHED,
    PUDDLE,
    REPEAT,
    Episodes,
    evaluated,
    puddle_assistant,
    seeds_of,
    short_episodes,
)
from wasp_cli.errors import TaskError, UnknownName, UsageError
from wasp_cli.notebook.assistant import LoadedAssistant
from wasp_cli.notebook.assisted_env import AssistedEnv

GOAL = "wasp_cli.tasks.gym:wasp/SafetyPointGoal1-v0"
RACE = "wasp_cli.tasks.gym:wasp/SafetyCarRace1-v0"
IDS = {"goal1": GOAL, "race1": RACE, PUDDLE: PUDDLE}


@pytest.fixture(scope="module")
def ida() -> LoadedAssistant:
    """Of race1."""
    return wasp_cli.load_assistant(PUBLISHED, "race1 s1 ida")


@pytest.fixture(scope="module")
def puddle(artifacts: Mapping[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """An untrained assistant of somebody else's environment."""
    results = tmp_path_factory.mktemp("puddle")
    puddle_assistant(artifacts, results)
    return wasp_cli.load_assistant(results)


def assisted(assistant: LoadedAssistant, **options: Any) -> AssistedEnv:
    """The environment that an assistant was trained on, with it inside."""
    own = {} if assistant.task == PUDDLE else {"observation": "all"}
    return wasp_cli.AssistedEnv(gymnasium.make(IDS[assistant.task], **own, **options), assistant)


def driven(env: AssistedEnv, operator: str, value: float, episode: int = 0) -> Episodes:
    """An episode under an impaired operator of ours, with the seeds of evaluations."""
    assistant = env.assistant
    world, mistakes, own = seeds_of(assistant, operator, episode)
    made = assistant.operator(operator, value, mistakes)
    env.reset(seed=world, options={"operator": made, "assistant_seed": own})
    rows: list[tuple[float, dict[str, Any]]] = []
    ended = False
    while not ended:
        _, reward, terminated, truncated, info = env.step(assistant.command())
        rows.append((reward, info))
        ended = terminated or truncated
    return Episodes(
        [np.array([info["command"] for _, info in rows])],
        [np.array([info["executed_action"] for _, info in rows])],
        [np.array([reward for reward, _ in rows], np.float32)],
        [[info["gate"] for _, info in rows]],
        [np.array([info.get("predicted_cost", np.nan) for _, info in rows], np.float32)],
    )


@pytest.mark.parametrize(
    ("name", "operator", "value", "decisions", "fires"),
    [
        ("race1 s1 wasp", "reaction-time", 0.24, 16, {"safety"}),
        ("race1 s1 wasp", "limited-skill", 0.25, 12, set()),
        ("race1 s1 ida", "noisy", 0.45, 40, {"method"}),
        ("race1 s1 human", "laggy", 0.7, 40, {"none"}),
        # it asks the operator in imagination
        ("goal1 s1 printed candidates=64", "limited-skill", 0.25, 6, {"safety"}),
    ],
)
def test_episodes_are_those_of_an_evaluation_to_the_bit(
    name: str, operator: str, value: float, decisions: int, fires: set[str], tmp_path: Path
) -> None:
    assistant = wasp_cli.load_assistant(PUBLISHED, name)
    with short_episodes(decisions):
        expected = evaluated(assistant, operator, value, tmp_path)
        found = driven(assisted(assistant), operator, value)
    assert len(expected.a[0]) == decisions
    found.require_same(expected)
    assert fires <= set(found.gate[0])


def test_an_environment_of_ours_may_repeat_by_itself(ida: LoadedAssistant) -> None:
    with short_episodes(20):
        outside = driven(assisted(ida), "noisy", 0.45)
        inside = assisted(ida, action_repeat=REPEAT)
        assert inside.action_repeat == 1
        driven(inside, "noisy", 0.45).require_same(outside)


def test_episodes_in_somebody_elses_environment_are_those_of_an_evaluation(
    puddle: LoadedAssistant, tmp_path: Path
) -> None:
    expected = evaluated(puddle, "noisy", 0.4, tmp_path)
    found = driven(assisted(puddle), "noisy", 0.4)
    found.require_same(expected)
    assert len(found.a[0]) > 10


class Drawn(Puddle):
    """A pond that is seen by drawing it, and whose info calls the cost otherwise."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (8,), np.float32)
    render_mode = None

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def _seen(self) -> Any:
        return super()._seen()["privileged"]

    def render(self) -> Any:
        return np.repeat(super()._seen()["image"], 2, 0)

    def step(self, action: Any) -> Any:
        *seen, info = super().step(action)
        return (*seen, {"wet": info["cost"]})


gymnasium.register("DrawnPond-v0", entry_point=Drawn, max_episode_steps=60)


def test_declared_environments_are_seen_as_they_were_declared(
    artifacts: Mapping[str, Path], tmp_path: Path
) -> None:
    declaration = {"id": "DrawnPond-v0", "image": "render", "cost": "info.wet"}
    puddle_assistant(artifacts, tmp_path / "results", task="pond", environment=declaration)
    assistant = wasp_cli.load_assistant(tmp_path / "results", "pond ida")
    expected = evaluated(assistant, "noisy", 0.4, tmp_path)
    env = wasp_cli.AssistedEnv(gymnasium.make("DrawnPond-v0", render_mode="rgb_array"), assistant)
    driven(env, "noisy", 0.4).require_same(expected)
    env.reset(seed=3)
    assert {"cost", "cost_sources"} <= set(env.step(np.zeros(2))[4])
    with pytest.raises(UsageError, match="render mode is None"):
        wasp_cli.AssistedEnv(gymnasium.make("DrawnPond-v0"), assistant)
    # in a loop of one's own, what is drawn is the observation
    assistant.reset(0)
    assistant.see(env.render())


class Sized(Drawn):
    """A pond whose size is an argument."""

    def __init__(self, render_mode: str | None = None, size: float = 2.0) -> None:
        super().__init__(render_mode)
        self.size = size


gymnasium.register("SizedPond-v0", entry_point=Sized, max_episode_steps=60)


@pytest.mark.parametrize(
    ("declared", "given", "differs"),
    [
        ({}, {}, None),
        ({"size": 3.0}, {"size": 3.0}, None),
        ({}, {"size": 2.0}, None),  # its default
        ({"size": 3.0}, {}, r"made with size=2\.0, .* trained with size=3\.0"),
        ({}, {"size": 1.0}, r"made with size=1\.0, .* trained with size=2\.0"),
    ],
)
def test_an_environment_that_was_made_otherwise_than_in_training_is_refused(
    artifacts: Mapping[str, Path],
    tmp_path: Path,
    declared: dict[str, Any],
    given: dict[str, Any],
    differs: str | None,
) -> None:
    declaration = {"id": "SizedPond-v0", "image": "render", "cost": "info.wet", "make": declared}
    puddle_assistant(artifacts, tmp_path, task="pond", environment=declaration)
    assistant = wasp_cli.load_assistant(tmp_path, "pond ida")
    env = gymnasium.make("SizedPond-v0", render_mode="rgb_array", **given)
    if differs is None:
        wasp_cli.AssistedEnv(env, assistant)
        return
    with pytest.raises(UsageError, match=differs) as refused:
        wasp_cli.AssistedEnv(env, assistant)
    assert "gymnasium.make('SizedPond-v0', size=" in str(refused.value.hint)


@pytest.mark.parametrize("name", ["wasp", "printed candidates=64", "ida"])
def test_an_assisted_environment_can_be_pickled(name: str) -> None:
    env = assisted(wasp_cli.load_assistant(PUBLISHED, f"race1 s1 {name}"))
    env.reset(seed=3, options={"assistant_seed": 5})
    again = pickle.loads(pickle.dumps(env))
    command = np.array([0.5, -0.5], np.float32)
    assert again.step(command)[1] == env.step(command)[1]
    assert np.array_equal(again.decision.action, env.decision.action)


def test_gymnasium_and_stable_baselines3_pass_it(
    ida: LoadedAssistant, puddle: LoadedAssistant
) -> None:
    for assistant, options in ((ida, {"render_mode": "rgb_array"}), (puddle, {})):
        with warnings.catch_warnings():
            # of the environments inside: no limits of vectors, an image with channels first
            warnings.simplefilter("ignore")
            check_env(assisted(assistant, **options), skip_render_check=False)
            check_with_baselines(assisted(assistant, **options))


def test_declared_environments_pass_too(artifacts: Mapping[str, Path], tmp_path: Path) -> None:
    """They are made again by their `spec`, with what the declaration wraps around them."""
    declaration = {"id": "DrawnPond-v0", "image": "render", "cost": "info.wet"}
    puddle_assistant(artifacts, tmp_path, task="pond", environment=declaration)
    assistant = wasp_cli.load_assistant(tmp_path, "pond ida")
    env = wasp_cli.AssistedEnv(gymnasium.make("DrawnPond-v0", render_mode="rgb_array"), assistant)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=False)
        again = gymnasium.make(env.spec)
    assert str(again).count("Translated") == 1
    again.reset(seed=0)
    assert {"cost", "gate"} <= set(again.step(np.zeros(2))[4])


def test_numbers_of_numpy_are_numbers(puddle: LoadedAssistant) -> None:
    env = wasp_cli.AssistedEnv(gymnasium.make(PUDDLE), puddle, action_repeat=np.int64(REPEAT))
    first, _ = env.reset(seed=3, options={"assistant_seed": 5})
    again, _ = env.reset(seed=np.int64(3), options={"assistant_seed": np.uint32(5)})
    assert np.array_equal(first["image"], again["image"])
    assert env.step(np.zeros(2))[4]["env_steps"] == REPEAT


@pytest.mark.parametrize(
    ("reset", "message"),
    [
        ({"seed": -1}, "seed=-1 is no seed"),
        ({"seed": "a"}, "seed='a' is no seed"),
        ({"seed": 1.5}, r"seed=1\.5 is no seed"),
        ({"seed": True}, "seed=True is no seed"),
        ({"options": [1]}, r"options=\[1\] is no dictionary"),
        ({"options": {"assistant_seed": -1}}, "assistant_seed=-1 is no seed"),
        ({"options": {"operator": "noisy"}}, "operator='noisy' is no operator"),
    ],
)
def test_what_reset_does_not_take_is_told(
    reset: dict[str, Any], message: str, puddle: LoadedAssistant
) -> None:
    env = assisted(puddle)
    env.reset(seed=0)
    with pytest.raises(UsageError, match=message):
        env.reset(**reset)
    with pytest.raises(TaskError, match="no episode is running"):
        env.step(np.zeros(2))
    env.reset(seed=0)
    env.step(np.zeros(2))


def test_what_is_no_environment_and_no_assistant_is_told(puddle: LoadedAssistant) -> None:
    inside = gymnasium.make(PUDDLE)
    vector = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make(PUDDLE)])
    for env, assistant, message in (
        (PUDDLE, puddle, "str is no gymnasium environment"),
        (puddle, inside, "LoadedAssistant is no gymnasium environment"),
        (inside, "ida", "str is no loaded assistant"),
        (vector, puddle, "a vector of them"),
        (gymnasium.wrappers.TimeLimit(assisted(puddle), 3), puddle, "assists in .* already"),
        (inside, puddle, "action_repeat=True"),
    ):
        with pytest.raises(UsageError, match=message):
            wasp_cli.AssistedEnv(env, assistant, action_repeat=True)  # type: ignore[arg-type]
    with pytest.raises(TaskError, match="mapped onto its bounds"):
        wasp_cli.AssistedEnv(gymnasium.wrappers.ClipAction(inside), puddle)


def test_a_step_is_a_decision(puddle: LoadedAssistant) -> None:
    """What it says of itself, beside the environment inside that is stepped by hand."""
    env, inside = assisted(puddle), gymnasium.make(PUDDLE)
    env.reset(seed=4)
    inside.reset(seed=4)
    for _ in range(20):
        seen, reward, terminated, truncated, info = env.step(np.array([1.0, 0.3]))
        rewards, costs, wet = 0.0, 0.0, 0.0
        bounds = inside.action_space.high
        for _ in range(REPEAT):
            told = inside.step((info["executed_action"] * bounds).astype(np.float32))
            rewards += told[1]
            costs += told[4]["cost"]
            wet += told[4]["cost_sources"]["water"]
            if told[2] or told[3]:
                break
        assert reward == pytest.approx(rewards, abs=1e-5)
        assert (info["cost"], info["cost_sources"]) == (costs, {"water": wet})
        assert info["success"] == told[4]["success"]
        assert np.array_equal(seen["image"], told[0]["image"])
        assert (terminated, truncated) == told[2:4]
        assert env.decision is not None
        assert info["gate"] == env.decision.gate
    assert info["env_steps"] == REPEAT


def test_two_environments_share_models_and_nothing_else(puddle: LoadedAssistant) -> None:
    one, other = assisted(puddle), assisted(puddle)
    alone = driven(one, "noisy", 0.4)
    other.reset(seed=1)
    one.reset(seed=2)
    other.step(np.array([0.1, 0.2]))
    driven(one, "noisy", 0.4).require_same(alone)
    assert one.assistant.parts is other.assistant.parts


def test_vectors_of_gymnasium_take_it(puddle: LoadedAssistant) -> None:
    vector = gymnasium.vector.SyncVectorEnv([lambda: assisted(puddle)] * 2)
    vector.reset(seed=3)
    *_, info = vector.step(np.zeros((2, 2), np.float32))
    assert info["executed_action"].shape == (2, 2)
    assert list(info["gate"]) == ["none", "none"] or set(info["gate"]) <= {"none", "method"}
    vector.close()


def test_what_the_assistant_sees_can_be_made_of_anything(ida: LoadedAssistant) -> None:
    """An environment that shows a vector, and an image that comes from elsewhere."""
    inner = gymnasium.make(RACE, observation="all")
    plain = wasp_cli.AssistedEnv(inner, ida, shown=lambda seen: seen["pixels"])
    with short_episodes(3):
        driven(plain, "noisy", 0.45).require_same(driven(assisted(ida), "noisy", 0.45))


def test_other_environments_are_refused(ida: LoadedAssistant, puddle: LoadedAssistant) -> None:
    with pytest.raises(UsageError, match="is the task 'goal1', which 'race1 s1 ida'"):
        wasp_cli.AssistedEnv(gymnasium.make(GOAL, observation="all"), ida)
    with pytest.raises(TaskError, match=r"is 'pixels' of float64 \[56\]"):
        wasp_cli.AssistedEnv(gymnasium.make(RACE), ida)
    with pytest.raises(TaskError, match=r"is .*'vision' of uint8"):
        wasp_cli.AssistedEnv(gymnasium.make(RACE, observation="vision"), ida)
    with pytest.raises(TaskError, match="actions of 2 numbers"):
        wasp_cli.AssistedEnv(gymnasium.make("Pendulum-v1"), puddle)
    with pytest.raises(TaskError, match="action space is Discrete"):
        wasp_cli.AssistedEnv(gymnasium.make("CartPole-v1"), puddle)
    with pytest.raises(UsageError, match="repeats an action 3 times"):
        assisted(ida, action_repeat=3)
    with pytest.raises(UsageError, match="no number of steps"):
        wasp_cli.AssistedEnv(gymnasium.make(PUDDLE), puddle, action_repeat=0)


def test_bad_commands_and_steps_out_of_turn_are_refused(puddle: LoadedAssistant) -> None:
    env = assisted(puddle)
    with pytest.raises(TaskError, match="no episode is running"):
        env.step(np.zeros(2))
    env.reset(seed=0)
    for command in (np.zeros(3), np.array([np.nan, 0.0]), None):
        with pytest.raises(TaskError, match="command"):
            env.step(command)  # type: ignore[arg-type]
    ended = False
    while not ended:
        _, _, terminated, truncated, _ = env.step(np.zeros(2))
        ended = terminated or truncated
    with pytest.raises(TaskError, match="no episode is running"):
        env.step(np.zeros(2))
    with pytest.raises(UnknownName):
        env.assistant.operator("sleepy", 0.4, 0)


def test_options_for_the_environment_inside_reach_it(ida: LoadedAssistant) -> None:
    with pytest.raises(UsageError, match="reset has no option 'colour'"):
        assisted(ida).reset(options={"colour": 1})
