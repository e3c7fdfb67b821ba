"""How long nodes take in an environment that nobody has measured, and at sizes without figures."""

from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from tests.commands import ROOT
from tests.run.harness import faked
from wasp_cli.plan import schedule, unmeasured
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.plan.text import show
from wasp_cli.plan.tried import Tried, keep, kept
from wasp_cli.plan.unmeasured import drives, guessed
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.spec.load import load
from wasp_cli.stages.expert import ACTING_EPISODES, REFERENCE_EPISODES
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


def judging(expert: Node) -> int:
    """Episodes that judge an expert: of every checkpoint, of two ways of acting, and some of zero
    and random commands.
    """
    each = expert.config["evaluation_episodes"]
    acting = 2 * min(ACTING_EPISODES, 3 * each)
    return len(expert.config["checkpoints"]) * each + acting + 2 * min(REFERENCE_EPISODES, each)


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
    expert, dataset = of(plan, "expert"), of(plan, "dataset")
    episodes = judging(expert)
    for node, of_a_decision, judged in (
        (expert, 4 * 0.001, episodes * 50),
        (dataset, 4 * 0.003, 0),
    ):
        more = known.seconds[node.sort] - alone.seconds[node.sort]
        assert more == pytest.approx(of_a_decision * (drives(node) + judged))
    keep("puddle:Puddle-v0", Tried(step_seconds=0.003, bare_seconds=0.001, length=100.0))
    assert drives(of(plan, "evaluate")) == 10 * 25, "episodes are as long as they were met"
    expert, took = of(plan, "expert"), 1000.0
    measured = guessed(plan.to_run(), presets, [(expert, took)])
    assert measured.seconds[expert.sort] == pytest.approx(took), "a node that has ended counts more"


def test_several_processes_share_the_steps_of_an_environment(tmp_path):
    """As many as a node has threads; a quick environment stays in one."""
    plan = planned(tmp_path)
    learned = plan.seconds[of(plan, "expert").sort]
    keep("puddle:Puddle-v0", Tried(step_seconds=0.003, bare_seconds=0.003, length=200.0))
    plan = planned(tmp_path)
    expert = of(plan, "expert")
    alone = replace(plan, steps=tuple(step for step in plan.steps if step.node == expert))
    stepped = 4 * 0.003 * (drives(expert) + 50 * judging(expert))
    assert alone.estimate(1)[0] == pytest.approx(learned + stepped)
    assert alone.estimate(2)[0] == pytest.approx(learned + stepped / 2)
    assert alone.estimate(2, cores=1)[0] == pytest.approx(learned + stepped)
    assert alone.critical_path(2)[0] == pytest.approx(learned + stepped / 2)
    most = alone.estimate(10_000)[0]
    assert most == pytest.approx(learned + stepped / expert.config["envs"])

    keep("puddle:Puddle-v0", Tried(step_seconds=1e-5, bare_seconds=1e-5, length=200.0))
    plan = planned(tmp_path)
    quick = replace(plan, steps=tuple(step for step in plan.steps if step.node == expert))
    assert quick.estimate(2) == quick.estimate(1)


def test_nodes_side_by_side_share_the_cores(tmp_path):
    """Two chains on two cores have a process each, and one chain has both."""
    keep("puddle:Puddle-v0", Tried(step_seconds=0.003, bare_seconds=0.003, length=200.0))

    def seconds(seeds: str) -> float:
        plan = planned(tmp_path, f"seeds={seeds}", "training_seed=null")
        experts = tuple(step for step in plan.steps if step.node.kind == "expert")
        return replace(plan, steps=experts).estimate(2)[0]

    one = planned(tmp_path)
    expert = of(one, "expert")
    shared = one.stepping[expert.sort].seconds / 2
    assert shared > 4 * 0.003 * drives(expert) / 2
    assert seconds("[0, 1]") == pytest.approx(seconds("[0]") + shared)


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
