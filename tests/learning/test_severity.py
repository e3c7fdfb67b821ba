"""The search for a severity, and the stage on tiny untrained models."""

import json
import math
from pathlib import Path

import pytest

from tests.cells import SETTINGS, short_episodes
from wasp_cli.learning import severity as module
from wasp_cli.learning.configs.severity import SeverityConfig
from wasp_cli.learning.severity import Driven, Kept, Ladder, References, search
from wasp_cli.operators.delayed import delay_steps
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.seeds import layout_seed
from wasp_cli.stages.base import Job
from wasp_cli.stages.severity import SeverityStage, ladder_of

TRIED = (0.2, 0.4, 0.6, 0.8, 1.0)


def driven(returned: float) -> Driven:
    return Driven((returned - 1.0, returned + 1.0), (0.0, 2.0))


REFERENCES = References(driven(-50.0), driven(50.0))


class Operator:
    """One who keeps a share of the way that follows from the severity."""

    def __init__(self, share):
        self.share, self.driven = share, []

    def __call__(self, severity):
        self.driven.append(severity)
        return driven(-50.0 + 100.0 * self.share(severity))


def test_it_drives_no_further_than_the_severity_that_keeps_less_and_then_the_choice():
    operator = Operator(lambda severity: 1.0 - severity**2)
    found = search(Ladder(TRIED, harmless=0.0), 0.6, REFERENCES, operator)
    # between .6, which keeps .64, and .8, which keeps .36
    assert found.choice.severity == pytest.approx(0.6 + 0.2 * 0.04 / 0.28, abs=1e-3)
    assert operator.driven == [0.2, 0.4, 0.6, 0.8, found.choice.severity]
    assert list(found.points) == operator.driven
    assert found.choice.within
    assert found.decided


def test_below_the_mildest_that_is_tried_lies_the_unimpaired_expert_where_there_is_one():
    operator = Operator(lambda severity: 0.2)
    assert search(Ladder(TRIED, harmless=0.0), 0.6, REFERENCES, operator).choice.severity == 0.1
    out_of_reach = search(Ladder(TRIED), 0.6, REFERENCES, operator)
    assert (out_of_reach.choice.severity, out_of_reach.choice.within) == (0.2, False)


def test_where_every_severity_keeps_more_the_worst_is_taken_and_it_says_so():
    operator = Operator(lambda severity: 0.9)
    found = search(Ladder(TRIED, harmless=0.0), 0.6, REFERENCES, operator)
    assert (found.choice.severity, found.choice.within) == (1.0, False)
    assert operator.driven == list(TRIED)


def test_without_a_way_to_the_expert_the_middle_is_taken_and_it_says_so():
    level = References(driven(3.0), driven(3.0))
    found = search(Ladder(TRIED, harmless=0.0), 0.6, level, Operator(lambda severity: 0.0))
    assert (found.choice.severity, found.choice.within, found.decided) == (0.6, False, False)
    assert math.isnan(level.share(found.points[0.6]))


def axis(operator: str, tried=None):
    info = OPERATORS[operator]
    return {
        "tried": list(tried or info.ladder()),
        "harmless": info.harmless,
        "between": info.between,
        "high": info.high,
    }


@pytest.mark.parametrize("seconds", [0.0667, 0.16, 0.4, 3.0, 20.0])
def test_a_delay_is_one_of_whole_decisions(seconds):
    ladder = ladder_of(axis("reaction-time"), seconds)
    assert all(0.0 < delay <= OPERATORS["reaction-time"].high for delay in ladder.tried)
    counts = [delay_steps(delay, seconds) for delay in ladder.tried]
    assert len(set(counts)) == len(counts)
    operator = Operator(lambda delay: 1.0 - 0.11 * delay_steps(delay, seconds))
    found = search(ladder, 0.45, REFERENCES, operator).choice
    assert delay_steps(found.severity, seconds) == (5 if found.within else counts[-1])


def test_a_skill_is_one_of_the_checkpoints():
    ladder = ladder_of(axis("limited-skill", tried=[0.5, 0.25, 0.1]), 0.4)
    shares = {0.5: 0.9, 0.25: 0.7, 0.1: 0.2}
    operator = Operator(shares.__getitem__)
    assert search(ladder, 0.6, REFERENCES, operator).choice.severity == 0.25
    assert search(ladder, 0.4, REFERENCES, operator).choice.severity == 0.1
    assert set(operator.driven) == set(shares)


@pytest.mark.parametrize("operator", [name for name in OPERATORS.own if OPERATORS[name].simulated])
def test_what_every_operator_tries_lies_in_its_range(operator):
    info = OPERATORS[operator]
    tried = ladder_of(axis(operator), 0.1).tried
    assert all(info.low <= severity <= info.high for severity in tried)
    assert len(tried) > 1
    assert info.harmless not in tried


def test_an_interrupted_search_goes_on_where_it_was(tmp_path):
    ladder = Ladder(TRIED, harmless=0.0)

    class Interrupted(Exception):
        pass

    def first(severity):
        if severity > 0.5:
            raise Interrupted
        return driven(-50.0 + 100.0 * (1.0 - severity**2))

    with pytest.raises(Interrupted):
        search(ladder, 0.6, REFERENCES, Kept(tmp_path, first, lambda count: None))
    again = Operator(lambda severity: 1.0 - severity**2)
    told = []
    found = search(ladder, 0.6, REFERENCES, Kept(tmp_path, again, told.append))
    assert again.driven == [0.6, 0.8, found.choice.severity]
    assert told == [1, 2, 3, 4, 5]
    whole = search(ladder, 0.6, REFERENCES, Operator(lambda severity: 1.0 - severity**2))
    assert found == whole


# -- the stage -------------------------------------------------------------------------------------


@pytest.fixture(scope="module", autouse=True)
def short():
    with short_episodes():
        yield


def stage(folder: Path, inputs, operator: str, episodes: int = 2):
    """Run the stage for an operator on race1; returns the folder of its artifact, and what it
    tells.
    """
    folder.mkdir(parents=True)
    (folder / "work").mkdir()
    settings = {name: SETTINGS[name] for name in SeverityStage.settings}
    axes = {"operator": operator}
    if operator != "none":
        axes["ladder"] = axis(operator)
    told = SeverityStage().run(
        Job(
            "severity",
            "race1",
            0,
            SeverityConfig(episodes=episodes),
            settings,
            axes,
            inputs,
            folder,
            folder / "work",
        )
    )
    return folder, told


@pytest.fixture(scope="module")
def references(artifacts, tmp_path_factory):
    return stage(tmp_path_factory.mktemp("references") / "out", artifacts, "none")[0]


def test_the_same_seeds_choose_the_same_and_the_summary_has_the_numbers(
    artifacts, references, tmp_path
):
    inputs = {**artifacts, "references": references}
    found = [stage(tmp_path / name, inputs, "noisy") for name in ("one", "two")]
    texts = [(folder / "severity.json").read_bytes() for folder, _ in found]
    assert texts[0] == texts[1]
    document = json.loads(texts[0])
    told = found[0][1]
    assert told["severity"] == document["severity"]
    assert told["within"] == document["within"]
    point = next(p for p in document["points"] if p["severity"] == document["severity"])
    assert told["return"] == pytest.approx(sum(point["returns"]) / 2, abs=0.01)


def test_no_world_is_one_of_an_evaluation(artifacts, tmp_path, monkeypatch):
    met = []
    reset = module.run_episodes

    def seen(task, model, operator, assistant, layouts, own, **options):
        met.extend(layouts)
        return reset(task, model, operator, assistant, layouts, own, **options)

    monkeypatch.setattr(module, "run_episodes", seen)
    stage(tmp_path / "out", artifacts, "none", episodes=3)
    assert len(set(met)) == 3
    evaluated = {layout_seed("race1", 0, episode) for episode in range(1000)}
    assert not evaluated & set(met)
