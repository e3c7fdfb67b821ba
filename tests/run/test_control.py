"""A live run from another terminal: paused, resumed, parts of it taken back; and a run without a terminal."""

import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import Result

from tests.commands import run_here
from tests.run.harness import as_undisturbed, events, finished, prepared, run, start, wait_until, wasp
from wasp_cli.run.pool import InlinePool
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner

NODES = 36
"""Of the small spec."""


@contextmanager
def going(spec: Path, results: Path, jobs: int = 1) -> Iterator[subprocess.Popen[str]]:
    process = start("run", spec, "--results", results, "-j", str(jobs))
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=600)


def control(*arguments: str | Path) -> Result:
    return run_here("control", *arguments, columns=200)


def test_a_paused_run_begins_nothing_new_and_goes_on_when_told(fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(seconds=0.3)
    with going(small_spec, results) as process:
        wait_until(lambda: len(finished(results)) >= 2)
        assert "small: paused; running nodes finish" in control("pause", "--results", results).stdout
        wait_until(lambda: "paused" in events(results) and not list(results.glob("runs/*/running/*.json")))
        begun = len(fakes.executions())
        assert begun == len(finished(results)) < NODES
        assert ", paused" in run_here("status", results, columns=200).stdout
        assert len(fakes.executions()) == begun
        assert "small: goes on" in control("resume", "--results", results).stdout
        _, errors = process.communicate(timeout=600)
        assert process.returncode == 0, errors
    assert "nothing new begins" in errors
    assert len(finished(results)) == NODES
    refused = control("pause", "--results", results)
    assert (refused.exit_code, "no run goes on" in refused.stderr) == (2, True)


@pytest.mark.parametrize("behaviour", ["sleep", pytest.param("hang", marks=pytest.mark.slow)])
def test_a_running_node_that_is_taken_back_ends_and_the_others_go_on(behaviour, fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(behave={"goal1 s0 world_model": behaviour})
    with going(small_spec, results) as process:
        wait_until(lambda: any("s0 world_model" in line for line in fakes.executions()))
        told = control("cancel", "goal1 s0 world_model", "--results", results)
        assert "goal1 s0 world_model is taken back, and " in told.stdout
        _, errors = process.communicate(timeout=600)
        assert process.returncode == 1
    assert "1 cancelled:\n  goal1 s0 world_model" in errors
    assert "Traceback" not in errors
    assert not list(results.glob("failures/*"))  # nothing has gone wrong
    fakes.set()
    assert run(small_spec, results).complete
    assert as_undisturbed(small_spec, results)


def test_a_waiting_node_that_is_taken_back_never_begins(fakes, small_spec, tmp_path):
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    cell = next(node for node in plan.to_run() if node.label == "goal1 s0 wasp noisy=0.2")
    run_id = new_run(layout, loaded, plan)
    layout.cancelled(run_id).mkdir()
    layout.cancel(run_id, cell.key).touch()
    summary = Runner(layout, run_id, InlinePool()).run(plan)
    assert (summary.cancelled, summary.done) == ([cell], NODES - 1)


def test_what_cannot_be_taken_back_is_told(fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(behave={"world_model": "sleep"})
    _, _, plan = prepared(small_spec, results)
    expert = next(node.key for node in plan.to_run() if node.label == "goal1 s0 expert")
    with going(small_spec, results):
        wait_until(lambda: expert in finished(results) and "done" in events(results))
        for asked, message in (
            (["cancel", "goal1 s0 wolrd_model"], "did you mean 'goal1 s0 world_model'?"),
            (["cancel", "goal1 s0 expert"], "'goal1 s0 expert' has ended"),
            (["cancel"], "cancel which node?"),
            (["pause", "results/"], "'results/' is too much: pause is for whole runs"),
        ):
            refused = control(*asked, "--results", results)
            assert (refused.exit_code, refused.stdout) == (2, "")
            assert message in refused.stderr


def test_a_detached_run_says_where_it_is_and_goes_on(fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(seconds=0.1)
    begun = wasp("run", small_spec, "--results", results, "-j", "2", "--detach")
    assert (begun.returncode, begun.stderr) == (0, "")
    said = json.loads(begun.stdout)
    assert set(said) == {"spec", "run", "folder", "pid", "log"}
    assert Path(said["folder"]) == results / "runs" / said["run"]
    assert os.getsid(said["pid"]) == said["pid"]  # no terminal takes it along
    wait_until(lambda: "run ended" in events(results))
    assert len(finished(results)) == NODES
    wait_until(lambda: f"{NODES} computed" in Path(said["log"]).read_text(encoding="utf-8"))
