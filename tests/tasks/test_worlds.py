"""Worlds follow their seeds alone, and two environments are two: what is refused, and where."""

import itertools
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.tasks.lights import Lights, registered
from wasp_cli.errors import TaskError
from wasp_cli.tasks.foreign.elsewhere import require_same_elsewhere
from wasp_cli.tasks.foreign.examine import examine, require_two
from wasp_cli.tasks.foreign.learnable import findings_of
from wasp_cli.tasks.foreign.make import make_env
from wasp_cli.tasks.foreign.worlds import require_restored

ROOT = Path(__file__).parents[2]


class Walk(Lights):
    """A number that walks with the commands, shown in the image."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = float(self.np_random.uniform(0, 100))
        return self.seen(), {}

    def step(self, action):
        self.clock += 1
        self.place += float(action[0])
        return self.seen(), self.place, False, False, {"cost": float(self.clock % 3 == 0)}

    def seen(self):
        place = getattr(self, "place", 0.0)
        return np.full((64, 64, 3), int(place * 10) % 256, np.uint8)


class OwnBuffer(Walk):
    """Shows its state in an array that it fills again, as many environments do for speed."""

    def seen(self):
        if not hasattr(self, "buffer"):
            self.buffer = np.zeros((64, 64, 3), np.uint8)
        self.buffer[...] = super().seen()
        return self.buffer


class UnseededBuffer(OwnBuffer):
    def reset(self, **options):
        super().reset(**options)
        self.place = float(np.random.default_rng().uniform(0, 100))
        return self.seen(), {}


class ChanceInSteps(Walk):
    def step(self, action):
        return super().step(action + np.random.default_rng().normal(0, 1, 2))


class GlobalChance(Walk):
    def reset(self, *, seed=None, options=None):
        np.random.seed(seed)  # noqa: NPY002
        return super().reset(seed=seed)

    def step(self, action):
        return super().step(action + np.random.normal(0, 1, 2))  # noqa: NPY002


class Remembers(Walk):
    """Leaves something behind for the next episode."""

    episodes = 0

    def reset(self, **options):
        super().reset(**options)
        self.episodes += 1
        self.place += self.episodes
        return self.seen(), {}


class Counted(Walk):
    numbers = itertools.count()

    def __init__(self):
        self.number = next(Counted.numbers)

    def reset(self, **options):
        super().reset(**options)
        self.place += self.number
        return self.seen(), {}


class SharedClass(Walk):
    where: Any = None

    def reset(self, **options):
        first = super().reset(**options)
        SharedClass.where = self.place
        return first

    def step(self, action):
        self.place = SharedClass.where
        done = super().step(action)
        SharedClass.where = self.place
        return done


MODULE: dict[str, float] = {}


class SharedModule(Walk):
    def reset(self, **options):
        first = super().reset(**options)
        MODULE["place"] = self.place
        return first

    def step(self, action):
        self.place = MODULE["place"]
        done = super().step(action)
        MODULE["place"] = self.place
        return done


@pytest.mark.parametrize("env", [Walk, OwnBuffer])
def test_honest_environments_pass(env):
    name = registered(env)
    assert examine(name).cost_sources == ("cost",)
    require_two(name)


@pytest.mark.parametrize(
    ("env", "where"),
    [(UnseededBuffer, "first observation"), (ChanceInSteps, "step 1"), (Remembers, "observation")],
)
def test_an_episode_that_is_another_one_the_second_time_is_refused(env, where):
    with pytest.raises(TaskError, match="another episode the second time") as caught:
        examine(registered(env))
    assert where in caught.value.message
    assert "self.np_random" in str(caught.value.hint)


@pytest.mark.parametrize(
    ("env", "where"),
    [
        (SharedClass, "beside a second instance"),
        (SharedModule, "beside a second instance"),
        (GlobalChance, "beside a second instance"),
        (Counted, "in a second instance"),
    ],
)
def test_instances_that_share_something_are_refused(env, where):
    name = registered(env)
    with pytest.raises(TaskError, match=where):
        require_two(name)


class Half(Walk):
    """Its snapshot lacks the place."""

    def snapshot(self):
        return {"clock": np.array(self.clock)}

    def restore(self, arrays):
        self.clock = int(arrays["clock"])


class Whole(Half):
    def snapshot(self):
        return super().snapshot() | {"place": np.array(self.place)}

    def restore(self, arrays):
        super().restore(arrays)
        self.place = float(arrays["place"])


def test_a_snapshot_that_lacks_something_is_refused():
    assert not require_restored(make_env(registered(Walk)), 4)
    assert require_restored(make_env(registered(Whole)), 4)
    with pytest.raises(TaskError, match="goes on differently"):
        require_restored(make_env(registered(Half)), 4)


HASHED = """
import gymnasium
from tests.tasks.test_worlds import Walk

class Hashed(Walk):
    def reset(self, **options):
        super().reset(**options)
        self.place += list({"red", "green", "blue", "white"}).index("red")
        return self.seen(), {}

class Honest(Walk): ...

for env in (Hashed, Honest):
    gymnasium.register(f"{env.__name__}-v0", entry_point=env, max_episode_steps=20)
"""
ASK = """
import sys
from wasp_cli.errors import TaskError
from wasp_cli.tasks.foreign.make import make_env
from wasp_cli.tasks.foreign.elsewhere import require_same_elsewhere
for name in ("hashed:Honest-v0", "hashed:Hashed-v0"):
    try:
        require_same_elsewhere(name, make_env(name), 4)
        print("same")
    except TaskError as error:
        print(error.message)
"""


def test_an_order_of_a_set_is_another_one_in_another_process(tmp_path):
    (tmp_path / "hashed.py").write_text(HASHED, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", ASK],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PYTHONHASHSEED": "5", "PATH": ""},
        capture_output=True,
        text=True,
        check=True,
    )
    honest, hashed = done.stdout.splitlines()
    assert honest == "same"
    assert "in another process" in hashed


def test_an_environment_that_another_process_cannot_make_says_so():
    name = registered(Walk)  # in this process alone
    with pytest.raises(TaskError, match="does not work in another process"):
        require_same_elsewhere(name, make_env(name), 2)


# What cannot be learned from.


def changed(**parts: Any) -> type[Walk]:
    return type("Changed", (Walk,), parts)


def info(cost: Any) -> Any:
    return lambda self, action: (*Walk.step(self, action)[:4], {"cost": cost(self)})


@pytest.fixture
def findings(monkeypatch):
    """What is found in an environment that is registered in this process alone."""
    from wasp_cli.tasks.foreign import learnable

    monkeypatch.setattr(learnable, "require_same_elsewhere", lambda *_: None)
    return lambda env, **options: findings_of(registered(env, **options), 4, steps=200)


@pytest.mark.parametrize(
    ("env", "expected"),
    [
        (changed(step=info(lambda env: 0.0)), "it never costs"),
        (changed(step=info(lambda env: 1.0)), "it always costs"),
        (changed(ends_at=1, step=lambda self, action: at_once(self, action)), "end at once"),
        (changed(seen=lambda self: np.zeros((64, 64, 3), np.uint8)), "image is the same"),
        (changed(step=lambda self, action: Walk.step(self, action * 0)), "whatever is commanded"),
    ],
)
def test_an_environment_that_cannot_be_learned_from_is_named(findings, env, expected):
    found = findings(env)
    assert expected in " ".join(message for message, _ in found.problems)


def at_once(env: Walk, action: Any) -> Any:
    seen, reward, _, cut, told = Walk.step(env, action)
    return seen, reward, True, cut, told


def test_an_environment_that_can_be_learned_from_has_notes_alone(findings):
    found = findings(Walk)
    assert found.problems == []
    assert "success" in " ".join(found.notes), "its success rate stays at 0 %"
    assert "snapshot" in " ".join(found.notes)


def test_who_costs_seldom_is_found_by_a_longer_look(monkeypatch):
    from wasp_cli.tasks.foreign import learnable

    monkeypatch.setattr(learnable, "require_same_elsewhere", lambda *_: None)
    rarely = changed(step=info(lambda env: float(env.clock > 390)))
    short = findings_of(registered(rarely, max_episode_steps=400), 4, steps=100)
    long = findings_of(registered(rarely, max_episode_steps=400), 4, steps=800)
    assert [message for message, _ in short.problems if "never costs" in message]
    assert not long.problems
