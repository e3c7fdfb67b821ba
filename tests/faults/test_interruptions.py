"""`wasp run` itself is interrupted or killed; the next run goes on from there."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.commands import run_here
from tests.run.harness import (
    ROOT,
    as_undisturbed,
    finished,
    goes_on,
    group_is_gone,
    prepared,
    start,
    wait_until,
)
from wasp_cli.errors import TimeLimitExceeded
from wasp_cli.run.limit import interruptible, was_ended
from wasp_cli.run.pools.base import Pool
from wasp_cli.run.pools.local import InlinePool, LokyPool
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner, Summary
from wasp_cli.run.worker import KILLED
from wasp_cli.store.plain import read_json_lines
from wasp_cli.store.records import read_record


@pytest.mark.parametrize(
    ("number", "whole_group", "jobs"),
    [
        pytest.param(signal.SIGINT, True, 2, id="ctrl-c"),
        pytest.param(signal.SIGTERM, False, 2, id="sigterm", marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, True, 0, id="ctrl-c without workers", marks=pytest.mark.slow),
    ],
)
def test_the_first_signal_lets_finish_what_runs(
    number, whole_group, jobs, fakes, small_spec, results
):
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
    assert len(fakes.executions()) == len(finished(results)), "something began and did not finish"
    assert not list(results.glob("tmp/*"))
    (journal,) = results.glob("runs/*/journal.jsonl")
    assert [event["event"] for event in read_json_lines(journal)][-1] == "run interrupted"
    goes_on(fakes, small_spec, results)


@pytest.mark.parametrize(
    "jobs", [2, pytest.param(1, marks=pytest.mark.slow), pytest.param(0, marks=pytest.mark.slow)]
)
def test_the_second_signal_ends_it_at_once_and_keeps_what_is_finished(
    jobs, fakes, small_spec, results
):
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
    goes_on(fakes, small_spec, results)


def test_two_runs_share_one_store(fakes, small_spec, results):
    fakes.set(seconds=0.05)
    both = [start("run", small_spec, "--results", results, "-j", "0") for _ in range(2)]
    errors = [process.communicate(timeout=600)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], errors
    ran = fakes.executions()
    assert len(ran) == len(set(ran)) == len(finished(results))
    assert as_undisturbed(small_spec, results)


# Nodes that take too long, sleep for ever, hang in native code, kill their worker, or eat memory
# until they are killed.


NODE = "goal1 s0 evaluate human {} noisy"
LABEL = "goal1 s0 human noisy=0.2"


def limited_run(
    spec: Path, results: Path, pool: Pool, limit: float | None, retries: int = 0
) -> Summary:
    loaded, layout, plan = prepared(spec, results)
    try:
        return Runner(
            layout, new_run(layout, loaded, plan), pool, limit=limit, retries=retries
        ).run(plan)
    finally:
        pool.close(kill=True)


def test_workers_begin_with_signals_held_back():
    """In a process of its own: in this one the trackers run already, which lift the mask when
    they start.
    """
    code = (
        "import signal; from joblib.externals.loky.backend import fork_exec as f; from "
        "wasp_cli.run import signals; from wasp_cli.run.pools import local as pool\n"
        "began, masks = f.fork_exec, []\n"
        "f.fork_exec = lambda *a, **k: "
        "(masks.append(signal.pthread_sigmask(signal.SIG_BLOCK, [])), began(*a, **k))[1]\n"
        "with signals.signals_wait(): workers = pool._new_workers(2); workers.submit(int)\n"
        "workers.shutdown(kill_workers=True); print([set(signals.SIGNALS) <= mask for mask in "
        "masks[-2:]])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=True,
    )
    assert done.stdout == "[True, True]\n"


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize(
    ("behaviour", "message"),
    [
        ("sleep", "it took longer than the limit of 8.0 s"),
        ("hang", "it exceeded its time limit and did not stop, so its process was ended"),
    ],
)
def test_a_node_that_sleeps_or_hangs_is_ended_and_named_and_the_others_finish(
    jobs, behaviour, message, fakes, small_spec, tmp_path
):
    fakes.set(behave={NODE: behaviour})
    summary = limited_run(small_spec, tmp_path / "results", LokyPool(jobs), limit=8.0)
    ((node, result),) = summary.failed
    assert (node.label, result.message) == (LABEL, message)
    assert not summary.blocked
    assert sum(NODE in line for line in fakes.executions()) == 1, "what hangs once would hang again"
    assert not list((tmp_path / "results").glob("runs/*/running/*"))
    goes_on(fakes, small_spec, tmp_path / "results")


@pytest.mark.slow
def test_a_node_that_eats_memory_until_it_is_killed_is_named_with_what_it_held(
    fakes, small_spec, results
):
    fakes.set(behave={NODE: "eat"})
    process = start("run", small_spec, "--results", results, "-j", "2")
    killed = 0

    def killer() -> None:
        """The kernel, when memory runs out."""
        nonlocal killed
        while process.poll() is None:
            for path in results.glob("runs/*/running/*.json"):
                record = read_record(path) or {}
                if record.get("label") == LABEL and float(record.get("memory_mb", 0)) > 300:
                    os.kill(int(record["pid"]), signal.SIGKILL)
                    killed += 1
                    time.sleep(0.5)
            time.sleep(0.02)

    thread = threading.Thread(target=killer)
    thread.start()
    _, errors = process.communicate(timeout=600)
    thread.join()
    assert process.returncode == 1
    assert killed == 2
    assert f"{LABEL}: {KILLED}; it last held " in errors
    held = float(errors.partition(f"{KILLED}; it last held ")[2].split()[0])
    assert 300 < held < 3000
    assert goes_on(fakes, small_spec, results) == 1


def test_what_fails_by_chance_is_tried_again_and_what_is_refused_is_not(
    fakes, small_spec, tmp_path
):
    fakes.set(behave={NODE: "raise once", "goal1 s0 ida_q": "refuse"})
    summary = limited_run(small_spec, tmp_path / "results", InlinePool(), limit=None, retries=2)
    assert [node.label for node, _ in summary.failed] == ["goal1 s0 ida_q"]
    assert sum(NODE in line for line in fakes.executions()) == 2
    assert sum("s0 ida_q" in line for line in fakes.executions()) == 1


def test_a_limit_reaches_a_thread_of_somebody_else(tmp_path):
    """As in a dask worker, where no signal arrives."""
    caught: list[BaseException] = []

    def work() -> None:
        try:
            with interruptible(0.2, tmp_path / "marker", own_process=False):
                while True:
                    time.sleep(0.01)
        except TimeLimitExceeded as error:
            caught.append(error)
        for _ in range(50):  # a late alarm would end this
            time.sleep(0.002)
        caught.append(StopIteration())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(300)
    assert [type(error) for error in caught] == [TimeLimitExceeded, StopIteration]
    assert not was_ended(tmp_path / "marker")


def test_the_time_is_typed_as_people_write_it(fakes, small_spec, tmp_path, monkeypatch):
    fakes.set(behave={NODE: "sleep"})
    monkeypatch.setattr(
        "wasp_cli.cli.run.show_report", lambda *_, **__: SimpleNamespace(missing=())
    )
    done = run_here(
        "run",
        small_spec,
        "--results",
        tmp_path / "results",
        "-j",
        "0",
        "--timeout",
        "4s",
        columns=200,
        code=1,
    )
    assert (
        f"{LABEL}: it took longer than the limit of 4.0 s\n      allow more time with --timeout"
        in done.stderr
    )
    for wrong in ("soon", "9223372036"):
        assert (
            f"invalid duration '{wrong}'"
            in run_here("run", small_spec, "--timeout", wrong, columns=80, code=2).stderr
        )


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_who_kills_its_worker_is_named_and_who_is_killed_by_chance_is_repeated(
    jobs, fakes, small_spec, tmp_path
):
    fakes.set(behave={NODE: "kill", "goal1 s0 world_model": "kill once"}, seconds=0.05)
    summary = limited_run(small_spec, tmp_path / "results", LokyPool(jobs), limit=None)
    assert [node.label for node, _ in summary.failed] == [LABEL]
    assert summary.failed[0][1].message.startswith(f"{KILLED}; it last held ")
    assert not summary.blocked
    ran = fakes.executions()
    # In flight at a death: the victim and at most one other. Nothing else runs twice.
    assert len(ran) - len(set(ran)) <= 2 * jobs
    assert goes_on(fakes, small_spec, tmp_path / "results") == 1
