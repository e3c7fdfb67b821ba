"""A plan carried out over fake stages: order, failure, repetition, records, counterfactual branches."""

import json
import random
import threading
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.run.harness import data_of, prepared, run
from wasp_cli.report.provenance import last_runs
from wasp_cli.run.pool import InlinePool, LokyPool
from wasp_cli.run.record import new_run, read_run
from wasp_cli.run.runner import Runner, Summary
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held
from wasp_cli.store.plain import read_json_lines


def test_a_run_computes_every_node_once_and_a_second_run_none(fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    _, _, plan = prepared(small_spec, results)
    summary = run(small_spec, results)
    assert summary.complete
    assert summary.done == len(plan.steps) == len(fakes.executions()) == len(set(fakes.executions()))
    _, _, again = prepared(small_spec, results)
    assert again.count("cached") == len(again.steps)
    (folder,) = (results / "runs").iterdir()
    assert not [left for place in (results / "tmp", results / "work", folder / "running") for left in place.iterdir()]
    assert run(small_spec, results).done == 0


def test_a_failure_blocks_its_dependents_only_and_runs_again(fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(behave={"s0 ida_q": "raise"})
    summary = run(small_spec, results)
    assert [node.kind for node, _ in summary.failed] == ["ida_q"]
    blocked = {(node.kind, node.axes["method"], node.seed) for node, _ in summary.blocked}
    assert blocked == {("calibration", "ida", 0), ("evaluate", "ida", 0)}
    result = summary.failed[0][1]
    assert result.message.startswith("ZeroDivisionError: one by zero (fake_stages.py:")
    assert "Traceback" in Path(result.log).read_text(encoding="utf-8")
    assert result.log
    _, layout, plan = prepared(small_spec, results)
    assert {(step.state, step.node.kind) for step in plan.steps if step.state != "cached"} == {
        ("failed", "ida_q"), ("missing", "calibration"), ("missing", "evaluate"),
    }  # fmt: skip
    fakes.set()
    repaired = run(small_spec, results)
    assert repaired.complete
    assert repaired.done == 1 + len(summary.blocked)
    assert read_manifest(layout, "ida_q", summary.failed[0][0].key)["provenance"]["attempt"] == 2
    assert not list(layout.failures.iterdir())


def test_the_manifest_tells_what_where_and_how(fakes, small_spec, tmp_path):
    run(small_spec, tmp_path / "results")
    layout = Layout(tmp_path / "results")
    (path,) = [path for path in layout.store.glob("critics/*/_manifest.json") if json.loads(path.read_text())["seed"] == 1]
    manifest = json.loads(path.read_text(encoding="utf-8"))
    assert manifest["key"] == path.parent.name
    assert manifest["label"] == "goal1 s1 critics"
    assert manifest["upstream"].keys() == {"dataset", "world_model", "latents", "policies", "heldout"}
    assert manifest["settings"] == {"action_repeat": 4, "returns": {"gamma_r": 0.99, "gamma_c": 0.95, "lam": 0.95}}
    assert manifest["summary"]["nothing"] is None
    assert manifest["provenance"]["attempt"] == 1
    assert manifest["provenance"]["versions"]["torch"]
    assert manifest["provenance"]["seconds"] >= 0
    assert manifest["sources"]


def test_the_journal_and_the_record_tell_the_run(fakes, small_spec, tmp_path):
    fakes.set(behave={"s0 ida_q": "refuse"})
    summary = run(small_spec, tmp_path / "results")
    layout = Layout(tmp_path / "results")
    runs, damaged = last_runs(layout)
    assert not damaged
    assert list(runs) == ["small"]
    events = read_json_lines(layout.run(runs["small"]) / "journal.jsonl")
    counts = {name: sum(event["event"] == name for event in events) for name in ("done", "failed", "blocked", "run started", "run ended")}
    assert counts == {"done": summary.done, "failed": 1, "blocked": len(summary.blocked), "run started": 1, "run ended": 1}
    recorded = read_run(layout, runs["small"])
    loaded, _, plan = prepared(small_spec, tmp_path / "results")
    assert recorded.spec == loaded.spec
    assert recorded.cells == [(cell, node.key) for cell, node in plan.grid.cells]


def test_workers_give_the_same_bytes_as_this_process(fakes, small_spec, tmp_path):
    run(small_spec, tmp_path / "inline")
    pool = LokyPool(2)
    try:
        summary = run(small_spec, tmp_path / "workers", pool)
    finally:
        pool.close(kill=True)
    assert summary.complete
    assert data_of(tmp_path / "workers") == data_of(tmp_path / "inline")
    logs = list((tmp_path / "workers/runs").glob("*/logs/*.log"))
    assert len(logs) == summary.done
    assert all("fake goal1" in log.read_text(encoding="utf-8") for log in logs)


def test_the_order_of_the_work_changes_no_byte(fakes, small_spec, tmp_path, monkeypatch):
    run(small_spec, tmp_path / "calm")
    calm = fakes.executions()
    chance = random.Random(1)
    monkeypatch.setattr("wasp_cli.run.runner.durations", lambda nodes, seconds: {node.key: chance.random() for node in nodes})
    run(small_spec, tmp_path / "shuffled")
    assert fakes.executions()[len(calm) :] != calm
    assert data_of(tmp_path / "shuffled") == data_of(tmp_path / "calm")


def test_a_node_that_another_run_computes_is_left_for_later_and_not_computed_twice(fakes, small_spec, tmp_path):
    """The other one goes on for a while: meanwhile everything is done that does not need it."""
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    first = plan.to_run()[0]
    started, finish = threading.Event(), threading.Event()

    def other() -> None:
        with held(layout.lock(first.key), lambda: True, {"pid": 1}):
            started.set()
            finish.wait(600)

    thread = threading.Thread(target=other)
    thread.start()
    started.wait()
    threading.Timer(1.0, finish.set).start()
    summary = Runner(layout, new_run(layout, loaded, plan), InlinePool()).run(plan)
    thread.join()
    assert summary.complete
    needing = {first.key}
    for node in plan.to_run():  # needed ones first
        needing |= {node.key} if any(needed.key in needing for needed in node.needs.values()) else set()
    others = [node.label for node in plan.to_run() if node.key not in needing]
    assert others, "there is nothing else to do"
    ran = [line.split()[:3] for line in fakes.executions()]
    assert ran[len(others)] == first.label.split(), "it was waited for before the others were done"
    assert len(fakes.executions()) == len(set(fakes.executions())) == summary.done


KIND = "counterfactual"


@pytest.fixture
def judged_spec(small_spec) -> Path:
    text = small_spec.read_text(encoding="utf-8").replace("seeds: [0, 1]", "seeds: [0]")
    small_spec.write_text(text + "stages: [diagnostics, counterfactual]\n", encoding="utf-8")
    return small_spec


def branches(results: Path) -> set[str]:
    return {path.name for path in results.glob(f"store/{KIND}/*")}


def words(summary: Summary) -> tuple[set[str], set[str]]:
    return {node.label for node, _ in summary.failed}, {node.label for node, _ in summary.blocked}


def test_every_cell_that_may_intervene_is_branched_after_it_and_never_twice(fakes, judged_spec, tmp_path):
    assert run(judged_spec, tmp_path / "results").complete
    executed = fakes.executions()
    judged = [line for line in executed if f" {KIND} " in line]
    assert len(judged) == 2 * 2  # ida and wasp under two operators
    for line in judged:
        cell = line.replace(KIND, "evaluate")
        assert executed.index(cell) < executed.index(line)
    assert not any(" human " in line or " expert " in line for line in judged)
    assert run(judged_spec, tmp_path / "results").done == 0
    assert len(fakes.executions()) == len(executed)


def test_the_plan_counts_them_and_selectors_find_them(fakes, judged_spec, tmp_path):
    shown = run_here("plan", judged_spec, "--results", tmp_path / "results", columns=200)
    assert "the interventions of 4 of them are judged by counterfactual branches" in shown.output
    assert any(line.split()[:2] == [KIND, "4"] for line in shown.output.splitlines())
    options = ("--select", "stage=counterfactual,method=ida,operator=laggy", "-j", "0", "--results", tmp_path / "results")
    assert "counterfactual ida laggy=0.7" in run_here("run", judged_spec, *options, columns=200).output
    assert len(branches(tmp_path / "results")) == 1
