"""`wasp try` on environments of which everything is known."""

import json

import numpy as np
import pytest
from PIL import Image

from tests.commands import run_here, wasp
from wasp_cli.learning.trial import try_environment

MODULE = '''
import gymnasium
import numpy as np


class Clock(gymnasium.Env):
    """An episode has 160 steps of .1 s. Costs come by chance, for three steps; the image is bright
    for a second before, unless it shows noise alone.
    """

    metadata = {"render_modes": [], "render_fps": 10}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gymnasium.spaces.Dict(
        {
            "image": gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8),
            "privileged": gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32),
        }
    )
    tells = True

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.clock, self.place = 0, 0.0
        begins = np.arange(20, 160, 40) + self.np_random.integers(0, 12, 4)
        self.costly = {int(step) + more for step in begins for more in range(3)}
        self.before = {int(step) - more for step in begins for more in range(1, 11)}
        return self.seen(), {}

    def step(self, action):
        self.clock += 1
        self.place += float(action[0])
        cost = float(self.clock in self.costly)
        info = {"cost": cost, "cost_sources": {"bell": cost, "fire": 0.0}, "is_success": False}
        return self.seen(), 0.5, self.clock == 160, False, info

    def seen(self):
        image = self.np_random.integers(0, 120, (64, 64, 3)).astype(np.uint8)
        image[:4, :4] = np.uint8(100 + 5 * np.tanh(self.place))
        if self.tells and self.clock + 1 in self.before:
            image[32:] += 100
        return {"image": image, "privileged": np.array([self.clock, self.place], np.float32)}


class Silent(Clock):
    tells = False


class Free(Clock):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def reset(self, **options):
        seen, info = super().reset(**options)
        return seen["privileged"], info

    def step(self, action):
        seen, reward, terminated, truncated, info = super().step(action)
        told = {"crashed": info["cost"] > 0, "depth": -2.5, "place": {"x": self.place}}
        return seen["privileged"], reward, terminated, truncated, told


class Nameless(Free):
    def step(self, action):
        *rest, info = super().step(action)
        return (*rest, {"depth": info["depth"], "bumps": float(info["crashed"])})


class Buttons(Clock):
    action_space = gymnasium.spaces.Discrete(4)

    def step(self, action):
        return super().step(np.array([float(action), 0.0]))


for made in (Clock, Silent, Free, Nameless, Buttons):
    gymnasium.register(f"{made.__name__}-v0", entry_point=made, max_episode_steps=200)
'''
SECONDS = "12"


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with the module of the environments."""
    folder = tmp_path_factory.mktemp("tried")
    (folder / "clocks.py").write_text(MODULE)
    return folder


@pytest.fixture(autouse=True)
def here(home, monkeypatch):
    """These tests run in that folder, with a cache folder of their own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "cache"))
    monkeypatch.chdir(home)


@pytest.fixture(scope="module")
def clock(home):
    """What is found out of the clock, and whose plan had no time before."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(home / "cache"))
        (home / "before.yaml").write_text(
            "name: before\npreset: smoke\ntask: clocks:Clock-v0\nmethods: [human]\n"
            "operators: {noisy: {moderate: 0.4}}\nseeds: [0]\n"
        )
        before = wasp(home, "plan", "before.yaml", code=0)
        assert "not counting about" in before.stdout
        done = wasp(
            home, "try", "clocks:Clock-v0", "--time", SECONDS, "--write", "clock.yaml", "--json",
            "--out", "clock.png", code=0,
        )  # fmt: skip
    (found,) = json.loads(done.stdout)
    return found


def test_it_tells_lengths_returns_and_costs_as_they_are(clock):
    for met in clock["drivers"]:
        assert set(met["lengths"]) == {160}
        assert met["returns"] == pytest.approx([80.0] * len(met["returns"]))
        assert met["sources"]["fire"] == 0
        assert met["sources"]["bell"] == met["costly"]
    whole = [met for met in clock["drivers"] if met["steps"] == sum(met["lengths"])]
    for met in whole:
        assert met["cost_per_1000"] == pytest.approx(1000 * 12 / 160)
    assert clock["cameras"] == 1
    assert clock["step_ms"] > 0


def test_a_cost_that_shows_before_it_comes_is_seen_and_one_that_does_not_is_not(clock):
    assert clock["foresight"]["low"] > 0.8
    silent = try_environment("clocks:Silent-v0", float(SECONDS)).sight
    assert silent.costly > 20
    assert silent.low < 0.6


def test_it_suggests_decisions_that_last_and_an_episode_that_has_enough_of_them(clock):
    assert clock["action_repeat"] * 0.1 <= 0.4
    assert 100 <= clock["limit"] / clock["action_repeat"] <= 300


def test_the_spec_to_start_with_is_one_and_has_a_time(clock, home):
    assert (home / "clock.yaml").read_text() == clock["spec"]
    planned = run_here("plan", "clock.yaml", columns=200, code=0)
    assert "not counting" not in planned.output
    again = run_here("plan", "before.yaml", columns=200, code=0)
    assert "not counting" not in again.output, "what was tried stands for what was not computed"
    assert set(clock["minutes"]) == {"quick", "cpu"}
    assert all(minutes > 0 for minutes in clock["minutes"].values())


def test_moments_of_an_episode_are_drawn_as_assistants_see_them(clock, home):
    with Image.open(home / "clock.png") as picture:
        pixels = np.asarray(picture.convert("RGB"))
    assert pixels.shape[1] > 4 * 256
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100


def test_a_spec_that_is_there_stays_unless_it_is_forced(home, clock):
    kept = (home / "clock.yaml").read_text()
    done = run_here("try", "clocks:Clock-v0", "--write", "clock.yaml", columns=200, code=2)
    assert "'clock.yaml' is there" in done.output
    assert (home / "clock.yaml").read_text() == kept


def test_an_entry_of_info_with_the_name_of_a_cost_is_taken_and_said(home):
    arguments = ("clocks:Free-v0", "--time", "6", "--write", "free.yaml")
    done = run_here("try", *arguments, columns=200, code=0)
    assert "info.crashed: bool  0 to 1" in done.output
    assert "info.place.x: float" in done.output
    text = (home / "free.yaml").read_text()
    assert "image: none" in text
    assert "cost: info.crashed      # a guess" in text
    run_here("check", "free.yaml", "--steps", "200", columns=200, code=0)


def test_what_lacks_a_cost_is_told_with_the_line_that_it_needs():
    done = run_here("try", "clocks:Nameless-v0", columns=300, code=1)
    assert "info.bumps: float  0 to 1" in done.output
    assert "`cost:` a number of info (info.depth, info.bumps)" in done.output


def test_discrete_actions_are_refused_with_what_to_do():
    done = run_here("try", "clocks:Buttons-v0", columns=300, code=1)
    assert "Discrete(4)" in done.output
    assert "continuous" in done.output


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["clocks:Clok-v0"], 2, "did you mean 'clocks:Clock-v0'"),
        (["goal1"], 2, "a task of wasp itself"),
        (["gaol1"], 2, "did you mean"),
        (["clocks:Clock-v0", "--write", "clock.txt"], 2, "no name of a spec"),
        (["clocks:Clock-v0", "--out", "clock.jpg"], 2, "no name of a picture"),
        (["clocks:Clock-v0", "--write", "nowhere/clock.yaml"], 2, "no folder"),
        (["clocks:Clock-v0", "--time", "soon"], 2, "invalid duration"),
        (["clocks:Clock-v0", "--set", "episodes=3"], 2, "--set"),
        (["nothing.yaml"], 3, "nothing.yaml"),
    ],
)
def test_wrong_arguments_are_refused(arguments, code, expected):
    done = run_here("try", *arguments, columns=300, code=code)
    assert expected in " ".join(done.output.split())
