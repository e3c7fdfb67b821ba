"""`wasp run` itself is interrupted or killed; the next run goes on from there."""

import os
import signal

import pytest

from tests.run.harness import as_undisturbed, finished, group_is_gone, run, start, wait_until, wasp
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import read_json_lines


@pytest.mark.parametrize(
    ("number", "whole_group", "jobs"),
    [
        pytest.param(signal.SIGINT, True, 2, id="ctrl-c"),
        pytest.param(signal.SIGTERM, False, 2, id="sigterm", marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, True, 0, id="ctrl-c without workers", marks=pytest.mark.slow),
    ],
)
def test_the_first_signal_lets_finish_what_runs(number, whole_group, jobs, fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(seconds=0.5)
    process = start("run", small_spec, "--results", results, "-j", str(jobs))
    wait_until(lambda: len(finished(results)) >= 2 and any(results.glob("runs/*/running/*.json")))
    begun = {path.stem for path in results.glob("runs/*/running/*.json")}
    (os.killpg if whole_group else os.kill)(process.pid, number)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 130
    assert errors.count("\ninterrupted: ") == 1
    assert errors.count("finishing running nodes") == 1
    assert "Traceback" not in errors
    wait_until(lambda: group_is_gone(process.pid))
    assert begun <= finished(results)
    ran = fakes.executions()
    assert len(ran) == len(finished(results)), "something began and did not finish"
    assert not list(results.glob("tmp/*"))
    (journal,) = results.glob("runs/*/journal.jsonl")
    assert [event["event"] for event in read_json_lines(journal)][-1] == "run interrupted"
    fakes.set()
    summary = run(small_spec, results)
    assert summary.complete
    assert len(fakes.executions()) == len(ran) + summary.done == len(finished(results))
    assert as_undisturbed(small_spec, results)


@pytest.mark.parametrize("jobs", [2, pytest.param(1, marks=pytest.mark.slow), pytest.param(0, marks=pytest.mark.slow)])
def test_the_second_signal_ends_it_at_once_and_keeps_what_is_finished(jobs, fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(free=6)
    process = start("run", small_spec, "--results", results, "-j", str(jobs))
    wait_until(lambda: len(finished(results)) >= 5)
    os.killpg(process.pid, signal.SIGINT)
    wait_until(lambda: any(results.glob("runs/*/stop")))
    assert process.poll() is None
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 130
    assert errors.count("\ninterrupted: ") == 1
    assert "nodes were finished and are kept" in errors
    assert "Traceback" not in errors
    wait_until(lambda: group_is_gone(process.pid))
    kept, ran = finished(results), len(fakes.executions())
    fakes.set()
    summary = run(small_spec, results)
    assert summary.complete
    assert summary.done == len(finished(results)) - len(kept)
    assert len(fakes.executions()) == ran + summary.done
    assert as_undisturbed(small_spec, results)


@pytest.mark.slow  # `test_random_kills` has some of each
@pytest.mark.parametrize("everything", [False, True], ids=["parent killed", "everything killed"])
def test_a_killed_run_leaves_no_workers_and_no_partial_artifacts(everything, fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(free=6)
    process = start("run", small_spec, "--results", results, "-j", "2")
    wait_until(lambda: len(finished(results)) >= 4 and any(results.glob("tmp/*")))
    (os.killpg if everything else os.kill)(process.pid, signal.SIGKILL)
    process.communicate(timeout=600)
    wait_until(lambda: group_is_gone(process.pid))
    assert all((folder / "data.bin").is_file() for folder in results.glob("store/*/*"))
    assert not everything or list(results.glob("tmp/*"))
    kept = finished(results)
    fakes.set()
    second = wasp("run", small_spec, "--results", results, "-j", "2")
    assert second.returncode == 0, second.stderr
    assert f"{len(finished(results)) - len(kept)} computed, {len(kept)} computed before" in second.stderr
    assert not list(results.glob("tmp/*"))
    assert as_undisturbed(small_spec, results)
    layout = Layout(results)
    events = [read_json_lines(journal)[-1]["event"] for journal in sorted(layout.runs.glob("*/journal.jsonl"))]
    assert events[-1] == "run ended"


def test_two_runs_share_one_store(fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(seconds=0.05)
    both = [start("run", small_spec, "--results", results, "-j", "1") for _ in range(2)]
    errors = [process.communicate(timeout=600)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], errors
    ran = fakes.executions()
    assert len(ran) == len(set(ran)) == len(finished(results))
    assert as_undisturbed(small_spec, results)
