"""The race of a knob's values, and the stage on tiny untrained models."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.cells import SETTINGS, evaluated, short_episodes
from wasp_cli.learning.assistants import (
    build_assistant,
    build_turned,
    load_parts,
    operating_words,
)
from wasp_cli.learning.configs import ReturnsConfig
from wasp_cli.learning.configs.operating import OperatingConfig
from wasp_cli.learning.operating import HeldOut, drivers, race, spread_values, worlds_of_a_round
from wasp_cli.methods.base import Decision
from wasp_cli.methods.human import HumanOnly
from wasp_cli.methods.record import blank_record
from wasp_cli.methods.registry import METHODS
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.stages.base import Job
from wasp_cli.stages.operating import OperatingStage
from wasp_cli.store.tables import TIMING, read_episodes

VALUES = (0.0, 0.25, 0.5, 1.0, 2.0)
OPERATORS = {"noisy": (0.2, 0.4), "laggy": (0.7,)}


def alone(worlds: int) -> list[HeldOut]:
    return [HeldOut(None, i, "noisy", 0.4, 10, 10.0 + i % 2, 5.0, 0, 0) for i in range(worlds)]


class Runner:
    """An assistant whose every episode in a world is better or worse by `effect` (return, cost)."""

    def __init__(self, effect):
        self.effect, self.driven = effect, []

    def __call__(self, value, worlds):
        self.driven += [(value, world) for world in worlds]
        gain, saving = self.effect(value)
        return [
            HeldOut(value, i, "noisy", 0.4, 10, 10.0 + i % 2 + gain, 5.0 - saving, 3, 2)
            for i in worlds
        ]


@pytest.mark.parametrize("budget", [5, 7, 10, 30, 61])
@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_no_more_episodes_than_the_budget_and_every_value_drives(budget, count):
    runner = Runner(lambda value: (1.0, 1.0 + value))
    found = race(VALUES[:count], budget, runner, alone(budget))
    assert len(runner.driven) <= budget
    assert {value for value, _ in runner.driven} == set(VALUES[:count])
    assert len(found.episodes) == len(runner.driven)


def test_values_drive_the_same_worlds_and_finalists_as_many():
    runner = Runner(lambda value: (1.0, 1.0 + value))
    found = race(VALUES, 30, runner, alone(30))
    for value in VALUES:
        worlds = [world for other, world in runner.driven if other == value]
        assert worlds == list(range(len(worlds)))
    assert len({point.episodes for point in found.finalists}) == 1
    assert max(point.episodes for point in found.points) == found.finalists[0].episodes
    assert found.chosen.value == 2.0


def test_values_that_are_clearly_of_no_use_get_no_second_round():
    found = race(VALUES, 30, Runner(lambda value: (-9.0, 4.0)), alone(30))
    assert found.chosen is None
    assert {point.episodes for point in found.points} == {worlds_of_a_round(5, 30)}


def test_nothing_is_given_up_after_a_single_world():
    found = race(VALUES, 10, Runner(lambda value: (-9.0, 4.0)), alone(10))
    assert [point.episodes for point in found.finalists] == [3, 3]
    assert found.chosen is None


def test_fewer_episodes_than_values_are_spread_over_them():
    assert spread_values(VALUES, 5) == list(VALUES)
    assert spread_values(VALUES, 1) == [0.5]
    assert len(set(spread_values(VALUES, 3))) == 3


def test_every_variant_drives_as_often_as_the_others():
    drawn = drivers(OPERATORS, 12, seed=3)
    assert [variant for variant, _ in drawn].count("laggy") == 6
    assert [drawn.count(("noisy", value)) for value in OPERATORS["noisy"]] == [3, 3]
    assert drivers(OPERATORS, 4, seed=3) == drawn[:4]


@pytest.fixture(scope="module", autouse=True)
def short():
    with short_episodes():
        yield


def stage(folder: Path, inputs, method: str, episodes: int = 3, **axes):
    """Run the stage for a method on race1; returns the folder of its artifact."""
    folder.mkdir(parents=True)
    settings = {name: SETTINGS[name] for name in OperatingStage.settings}
    config = OperatingConfig(episodes=episodes, operators=OPERATORS)
    identity = {"method": method, "method_config": {}, **axes}
    summary = OperatingStage().run(
        Job("operating", "race1", 0, config, settings, identity, inputs, folder, folder)
    )
    return folder, summary


def knob_of(method: str, *values: float):
    knob = METHODS[method].knob
    return {
        "symbol": knob.symbol,
        "turns": knob.turns,
        "name": knob.name,
        "values": list(values or knob.values),
    }


@pytest.fixture(scope="module")
def operators_alone(artifacts, tmp_path_factory):
    return stage(tmp_path_factory.mktemp("alone") / "out", artifacts, "human")[0]


def rows(folder: Path):
    return json.loads((folder / "held_out.json").read_text())


def test_an_assistant_and_the_operators_alone_meet_the_same_worlds(
    artifacts, operators_alone, tmp_path
):
    inputs = {**artifacts, "alone": operators_alone}
    knob = knob_of("diffusion", 0.0, 0.8)
    folder, _ = stage(tmp_path / "out", inputs, "diffusion", episodes=4, knob=knob)
    by_world = {row["world"]: row for row in rows(operators_alone)}
    turned = rows(folder)
    assert {row["value"] for row in turned} == {0.0, 0.8}
    for row in turned:
        same = by_world[row["world"]]
        assert (row["operator"], row["severity"]) == (same["operator"], same["severity"])
        # A ratio of 0 changes nothing: the commands, and with them the mistakes, are the same.
        if row["value"] == 0.0:
            assert row["return_"] == pytest.approx(same["return_"], abs=1e-5)
            assert row["interventions"] == 0
        else:
            assert row["interventions"] > 0


def test_the_stage_gives_the_same_bytes_again(artifacts, operators_alone, tmp_path):
    inputs = {**artifacts, "alone": operators_alone}
    folders = [
        stage(tmp_path / name, inputs, "csa", knob=knob_of("csa", 0.2, 0.69))[0]
        for name in ("first", "second")
    ]
    for name in ("held_out.json", "operating_point.json"):
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()


class Standstill:
    """Never lets the operator go anywhere, so that nothing is gained."""

    def __init__(self, config, parts):
        """Read nothing."""

    def reset(self, rows, seeds):
        """Keep nothing."""

    def decide(self, latent, a_h, operator):
        return Decision(torch.zeros_like(a_h), blank_record(len(a_h), GATE_METHOD))


STANDSTILL = f"{__name__}:Standstill"


def point_at(folder: Path, **changes) -> Path:
    """Write an artifact of the stage with a choice of one's own."""
    folder.mkdir(parents=True)
    document = {"method": "ida", "knob": None, "silent": False, "value": None, **changes}
    (folder / "operating_point.json").write_text(json.dumps(document))
    return folder


def same_rows(one: Path, other: Path) -> bool:
    first, second = (read_episodes([path]) for path in (one, other))
    names = [name for name in first.column_names if name not in ("method", *TIMING)]
    return first.select(names).equals(second.select(names))


def test_an_assistant_of_ones_own_that_does_harm_is_silent_and_evaluated_as_the_operators_alone(
    artifacts, operators_alone, tmp_path
):
    folder, summary = stage(
        tmp_path / "operating", {**artifacts, "alone": operators_alone}, STANDSTILL
    )
    assert summary["operating_point"] == "silent"
    (point,) = json.loads((folder / "operating_point.json").read_text())["points"]
    assert point["value"] is None
    assert point["return_"] < point["alone_return"]
    assert point["cost"] == point["alone_cost"]
    chosen = evaluated({**artifacts, "operating": folder}, tmp_path / "chosen", STANDSTILL)
    human = evaluated(artifacts, tmp_path / "human")
    given = evaluated(artifacts, tmp_path / "given", STANDSTILL)
    assert same_rows(chosen.path, human.path)
    assert not same_rows(given.path, human.path)
    assert chosen.summary["operating_point"] == "silent"
    assert "operating_point" not in given.summary


def test_an_assistant_is_built_at_the_point_that_was_chosen(artifacts, tmp_path):
    def built(name, **point):
        folder = point_at(tmp_path / str(len(list(tmp_path.iterdir()))), **point)
        parts = load_parts({**artifacts, "operating": folder}, ReturnsConfig())
        return build_assistant(name, {}, parts), operating_words(name, parts)

    wasp, words = built("wasp", method="wasp", knob=knob_of("wasp"), value=0.5)
    assert wasp.tau_r == pytest.approx(0.05)
    assert words == "tau_r, times 0.5"
    silent, words = built("ida", method="ida", silent=True)
    assert isinstance(silent, HumanOnly)
    assert words == "silent"
    ida, words = built("ida", method="ida")
    assert not isinstance(ida, HumanOnly)
    assert words == "as it is"
    # who practises drives alone, whoever's parts were loaded
    practising, words = built("human", method="wasp", knob=knob_of("wasp"), value=2.0)
    assert isinstance(practising, HumanOnly)
    assert words is None


@pytest.mark.parametrize("name", [name for name, info in METHODS.items() if info.knob])
def test_every_knob_changes_what_its_assistant_is_built_of(name, parts):
    known = {"tau_r": 0.1, "tau_c": 0.3, "tau_q": 0.2, "gamma": 0.8, "margin_p95": 0.4}
    loaded = replace(parts, thresholds=known)
    values = METHODS[name].knob.values
    assert len(values) == 5
    for value in values:
        assistant = build_turned(name, {}, loaded, knob_of(name), value)
        assert callable(assistant.decide)
