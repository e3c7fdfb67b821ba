"""How long nodes take in an environment that nobody has measured, and at sizes without figures."""

from pathlib import Path

import pytest
from rich.console import Console

from tests.commands import ROOT
from tests.run.harness import faked
from wasp_cli.plan import schedule, unmeasured
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import Plan, plan_against, show
from wasp_cli.plan.tried import Tried, keep, kept
from wasp_cli.plan.unmeasured import drives, guessed
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.spec.load import load
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.declared import declare

PUDDLE = ROOT / "docs/examples/puddle.yaml"
MINUTES = 12.6
"""That docs/own_task.md says for its run."""


@pytest.fixture(autouse=True)
def same_speed(monkeypatch) -> None:
    for module in (schedule, unmeasured):
        monkeypatch.setattr(module, "speed", lambda: schedule.shipped()["speed"])


@pytest.fixture(autouse=True)
def nothing_tried(tmp_path, monkeypatch) -> None:
    """What the user of this machine has tried counts for nothing."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def planned(folder: Path, *settings: str, spec: Path = PUDDLE) -> Plan:
    return plan_against(lay_out(load(spec, settings).spec), Layout(folder / "results"))


def text_of(plan: Plan, capsys: pytest.CaptureFixture[str]) -> str:
    show(plan, Console(width=300), 1)
    return capsys.readouterr().out


def of(plan: Plan, kind: str) -> Node:
    return next(node for node in plan.to_run() if node.kind == kind)


def test_a_plan_of_a_new_environment_says_what_is_known_and_what_is_not(tmp_path, capsys):
    plan = planned(tmp_path)
    seconds, unknown = plan.estimate(1)
    assert unknown == 0
    assert MINUTES / 2 < seconds / 60 < MINUTES * 2
    said = text_of(plan, capsys)
    assert f"for {len(plan.to_run())} nodes an estimate, from other tasks and sizes" in said
    assert "decisions in puddle:Puddle-v0: how long one takes there is known when" in said


def test_what_one_node_shows_of_an_environment_counts_for_all_that_drive_in_it(tmp_path):
    plan = planned(tmp_path)
    expert, presets = of(plan, "expert"), plan.grid.presets
    alone = guessed(plan.to_run(), presets, [])
    beyond = 0.01  # seconds of a decision in this environment, more than in ours
    took = alone.seconds[expert.sort] + beyond * expert.config["interactions"]
    known = guessed(plan.to_run(), presets, [(expert, took)])
    assert alone.decisions
    assert not known.decisions
    for node in plan.to_run():
        more = known.seconds[node.sort] - alone.seconds[node.sort]
        assert more == pytest.approx(beyond * drives(node))
    assert drives(of(plan, "dataset")) == 24_000
    assert drives(of(plan, "evaluate")) == 10 * 50
    assert drives(of(plan, "critics")) == 0


def test_what_was_tried_counts_where_no_node_has_ended(tmp_path):
    plan = planned(tmp_path)
    presets = plan.grid.presets
    alone = guessed(plan.to_run(), presets, [])
    keep("puddle:Puddle-v0", Tried(step_seconds=0.003, bare_seconds=0.001, length=200.0))
    known = guessed(plan.to_run(), presets, [])
    assert not known.decisions
    for kind, of_a_decision in (("expert", 4 * 0.001), ("dataset", 4 * 0.003)):
        node = of(plan, kind)
        more = known.seconds[node.sort] - alone.seconds[node.sort]
        assert more == pytest.approx(of_a_decision * drives(node))
    keep("puddle:Puddle-v0", Tried(step_seconds=0.003, bare_seconds=0.001, length=100.0))
    assert drives(of(plan, "evaluate")) == 10 * 25, "episodes are as long as they were met"
    expert, took = of(plan, "expert"), 1000.0
    measured = guessed(plan.to_run(), presets, [(expert, took)])
    assert measured.seconds[expert.sort] == pytest.approx(took), "a node that has ended counts more"


def test_a_tried_environment_counts_as_it_is_declared():
    name = "puddle:Puddle-v0"
    keep(name, Tried(0.003, 0.001, 200.0))
    declare(name, {"id": name, "limit": 60})
    try:
        assert kept(name) is None
    finally:
        declare(name, None)
    assert kept(name) == Tried(0.003, 0.001, 200.0)


def test_a_machine_on_which_learning_takes_longer_is_believed(tmp_path):
    plan = planned(tmp_path)
    presets, model = plan.grid.presets, of(plan, "world_model")
    alone = guessed(plan.to_run(), presets, [])
    slow = guessed(plan.to_run(), presets, [(model, 3 * alone.seconds[model.sort])])
    for kind in ("critics", "latents"):
        sort = of(plan, kind).sort
        assert slow.seconds[sort] == pytest.approx(3 * alone.seconds[sort])


@pytest.mark.parametrize("preset", ["smoke", "quick", "cpu", "gpu", "paper"])
@pytest.mark.parametrize("task", ["goal1", "race0", "goal2"])
def test_every_preset_and_task_of_ours_has_a_time(preset, task, tmp_path):
    methods = "methods=[human, ida, diffusion, saferl, csa, reach, wasp]"
    stages = "stages=[diagnostics, counterfactual]"
    settings = (f"preset={preset}", f"tasks=[{task}]", methods, stages)
    plan = planned(tmp_path, *settings, spec=ROOT / "specs/table1.yaml")
    assert not plan.unmeasured
    assert plan.estimate(1)[1] == 0


def test_after_the_first_node_of_a_run_a_plan_has_times_for_the_rest(tmp_path, capsys):
    with faked(tmp_path):
        results = tmp_path / "results"
        loaded = load(PUDDLE)
        run_spec(loaded, results, RunOptions(jobs=0), ["stage=expert"])
        plan = plan_against(lay_out(loaded.spec), Layout(results))
        assert plan.count("cached", "expert") == 1
        said = text_of(plan, capsys)
    assert "not counting" not in said
    assert "about " in said
