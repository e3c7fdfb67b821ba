"""Stages that fall short of their bars: a run says so and goes on; a strict one stops there."""

import json

import pytest

from tests.commands import run_here
from tests.run.harness import prepared
from wasp_cli.errors import CellsFailed
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.spec.load import load
from wasp_cli.store.artifact import exists

FEW = {"steps": 1000, "costly_share": 0.021}
BLIND = {"base@1": 0.05, "auprc@1": 0.06, "persistence@1": 0.05}


def run(spec, layout, **options):
    return run_spec(load(spec), layout.root, RunOptions(jobs=0, **options))


def kinds(nodes, seed):
    return {node.kind for node, *_ in nodes if node.seed == seed}


def test_a_run_says_what_falls_short_and_goes_on(fakes, small_spec, layout, capsys):
    fakes.set(summaries={"s0 dataset": FEW})
    session = run(small_spec, layout)
    assert session.summary.complete
    notes = [line for line in capsys.readouterr().err.splitlines() if " note " in line]
    (note,) = notes
    assert "goal1 s0 dataset falls short: 21 of 1,000 recorded decisions cost" in note
    assert "dataset.steps" in note, "what to do"
    shown = run_here("status", layout.root, columns=200, code=0).stdout
    assert "SHORT  goal1 s0 dataset: 21 of 1,000 recorded decisions cost" in shown
    (state,) = json.loads(run_here("status", layout.root, "--json", columns=120, code=0).stdout)
    (line,) = state["short"]
    assert line.startswith("goal1 s0 dataset: 21 of 1,000")


def test_a_strict_run_stops_there_keeps_what_is_stored_and_one_that_is_not_goes_on(
    fakes, small_spec, layout
):
    fakes.set(summaries={"s0 dataset": FEW})
    first = run(small_spec, layout, strict=True)
    ((node, result),) = first.summary.failed
    assert (node.kind, node.seed, result.short) == ("dataset", 0, True)
    assert exists(layout, "dataset", node.key), "the artifact is kept"
    assert not list(layout.failures.iterdir())
    blocked = kinds(first.summary.blocked, 0)
    assert {"world_model", "policies", "evaluate"} <= blocked
    assert not kinds(first.summary.blocked, 1), "another training goes on"
    with pytest.raises(CellsFailed, match="21 of 1,000") as raised:
        first.require_complete()
    assert "without --strict" in (raised.value.hint or "")
    done = len(fakes.executions())

    # again: nothing is computed, and the same is said
    second = run(small_spec, layout, strict=True)
    assert len(fakes.executions()) == done
    assert [(n.key, r.message) for n, r in second.summary.failed] == [(node.key, result.message)]
    assert {n.key for n, _ in second.summary.blocked} == {n.key for n, _ in first.summary.blocked}

    third = run(small_spec, layout)
    assert third.summary.complete
    assert len(set(fakes.executions())) == len(fakes.executions()), "nothing ran twice"

    # and with all of it stored, strict says it still
    fourth = run(small_spec, layout, strict=True)
    assert [n.key for n, _ in fourth.summary.failed] == [node.key]


def test_a_world_model_that_diagnostics_find_blind_stops_what_builds_on_it(
    fakes, small_spec, layout
):
    fakes.set(summaries={"s0 diagnostics": BLIND})
    session = run(small_spec, layout, strict=True)
    ((node, _),) = session.summary.failed
    assert node.kind == "diagnostics"
    assert {"policies", "evaluate"} <= kinds(session.summary.blocked, 0)
    ran = [name for name in fakes.executions() if " s0 " in name]
    assert not [name for name in ran if "evaluate" in name or "policies" in name], (
        "what judges comes before what builds on it"
    )
    again = run(small_spec, layout, strict=True)
    assert {"policies", "evaluate"} <= kinds(again.summary.blocked, 0)
    assert run(small_spec, layout).summary.complete


def test_the_command_ends_with_its_code(fakes, small_spec, layout):
    fakes.set(summaries={"s1 expert": {"return": 1.0, "zero": {"return": 2.0}}})
    ended = run_here(
        "run", small_spec, "--results", layout.root, "-j", "0", "--strict", columns=120, code=1
    )
    assert "the expert returns 1 an episode, and does not clearly beat zero commands 2" in (
        ended.stderr
    )
    assert "without --strict, a run goes on with it" in ended.stderr
    _, _, plan = prepared(small_spec, layout.root)
    assert plan.count("failed") == 0
