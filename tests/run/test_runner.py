"""A plan carried out over fake stages: order, failure, repetition, records."""

import json
import os
import platform
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from tests.run.fake_stages import Fake
from tests.run.harness import ROOT, data_of, prepared, run, wait_until
from wasp_cli.cells.asked import asked_of, asked_of_grid
from wasp_cli.cells.runs import last_runs, results_of
from wasp_cli.errors import StoreError
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.run import worker
from wasp_cli.run.heartbeat import forget
from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.pools.base import WorkersDied
from wasp_cli.run.pools.local import InlinePool, LokyPool
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner, job_of
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.run.signals import SIGNALS, signals_wait
from wasp_cli.run.worker import attempts, execute, execute_here
from wasp_cli.spec.load import Loaded, limited, load
from wasp_cli.store.artifact import exists, read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held
from wasp_cli.store.plain import read_json_lines
from wasp_cli.store.provenance import machine, provenance


def test_a_run_computes_every_node_once_and_a_second_run_none(fakes, small_spec, results):
    _, _, plan = prepared(small_spec, results)
    summary = run(small_spec, results)
    assert summary.complete
    assert (
        summary.done == len(plan.steps) == len(fakes.executions()) == len(set(fakes.executions()))
    )
    _, _, again = prepared(small_spec, results)
    assert again.count("cached") == len(again.steps)
    (folder,) = (results / "runs").iterdir()
    assert not [
        left
        for place in (results / "tmp", results / "work", folder / "running")
        for left in place.iterdir()
    ]
    assert run(small_spec, results).done == 0


def test_a_failure_blocks_its_dependents_only_and_runs_again(fakes, small_spec, results):
    fakes.set(behave={"s0 ida_q": "raise"})
    summary = run(small_spec, results)
    assert [node.kind for node, _ in summary.failed] == ["ida_q"]
    blocked = {(node.kind, node.axes["method"], node.seed) for node, _ in summary.blocked}
    assert blocked == {("calibration", "ida", 0), ("evaluate", "ida", 0)}
    result = summary.failed[0][1]
    assert result.message.startswith("ZeroDivisionError: one by zero (fake_stages.py:")
    assert "Traceback" in Path(result.log).read_text(encoding="utf-8")
    _, layout, plan = prepared(small_spec, results)
    assert {(step.state, step.node.kind) for step in plan.steps if step.state != "cached"} == {
        ("failed", "ida_q"),
        ("missing", "calibration"),
        ("missing", "evaluate"),
    }
    fakes.set()
    repaired = run(small_spec, results)
    assert repaired.complete
    assert repaired.done == 1 + len(summary.blocked)
    assert read_manifest(layout, "ida_q", summary.failed[0][0].key)["provenance"]["attempt"] == 2
    assert not list(layout.failures.iterdir())


def test_a_node_whose_lock_cannot_be_taken_is_on_record_as_failed(fakes, small_spec, results):
    _, layout, plan = prepared(small_spec, results)
    node = plan.to_run()[0]
    layout.lock(node.key).mkdir(parents=True)
    assert not run(small_spec, results).complete
    assert attempts(layout, node.key) == 1
    layout.failure(node.key).write_text('{"attempt": null}')
    assert attempts(layout, node.key) == 1, "how often is lost"


def test_the_manifest_tells_what_where_and_how(fakes, small_spec, layout, monkeypatch):
    # The run begins on another machine than a node is computed on, as with Slurm.
    monkeypatch.setattr(
        "wasp_cli.run.runner.provenance",
        lambda: provenance() | machine() | {"processor": "another", "host": "another"},
    )
    run(small_spec, layout.root)
    (path,) = [
        path
        for path in layout.store.glob("critics/*/_manifest.json")
        if json.loads(path.read_text())["seed"] == 1
    ]
    manifest = json.loads(path.read_text(encoding="utf-8"))
    assert manifest["key"] == path.parent.name
    assert manifest["label"] == "goal1 s1 critics"
    assert manifest["upstream"].keys() == {
        "dataset",
        "world_model",
        "latents",
        "policies",
        "heldout",
    }
    assert manifest["settings"] == {
        "action_repeat": 4,
        "returns": {"gamma_r": 0.99, "gamma_c": 0.95, "lam": 0.95},
    }
    assert manifest["summary"]["nothing"] is None
    assert manifest["provenance"]["attempt"] == 1
    assert manifest["provenance"]["versions"]["torch"]
    assert manifest["provenance"]["host"] == platform.node()
    assert manifest["provenance"]["processor"].endswith(torch.backends.cpu.get_cpu_capability())
    assert manifest["provenance"]["seconds"] >= 0
    assert manifest["sources"]


def test_the_journal_and_the_record_tell_the_run(fakes, small_spec, layout):
    fakes.set(behave={"s0 ida_q": "refuse"})
    summary = run(small_spec, layout.root)
    last = last_runs(layout)
    assert not last.damaged
    assert list(last.runs) == ["small"]
    events = read_json_lines(layout.run(last.runs["small"].run_id) / "journal.jsonl")
    counts = {
        name: sum(event["event"] == name for event in events)
        for name in ("done", "failed", "blocked", "run started", "run ended")
    }
    assert counts == {
        "done": summary.done,
        "failed": 1,
        "blocked": len(summary.blocked),
        "run started": 1,
        "run ended": 1,
    }
    recorded = asked_of(last.runs["small"])
    loaded, _, plan = prepared(small_spec, layout.root)
    assert recorded == asked_of_grid(layout, recorded.run_id, loaded.spec, plan.grid)


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


def test_a_node_that_another_run_computes_is_left_for_later_and_not_computed_twice(
    fakes, small_spec, tmp_path
):
    """The other one goes on until no worker has anything to do: meanwhile everything is done
    that does not need it.
    """
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    first, run_id, started = plan.to_run()[0], new_run(layout, loaded, plan), threading.Event()
    runner = Runner(layout, run_id, InlinePool())

    def other() -> None:
        with held(layout.lock(first.key), lambda: True):
            started.set()
            wait_until(
                lambda: '"waiting"' in layout.journal(run_id).read_text(encoding="utf-8"), 60.0
            )

    thread = threading.Thread(target=other)
    thread.start()
    started.wait()
    summary = runner.run(plan)
    thread.join()
    assert summary.complete
    needing = {first.key}
    for node in plan.to_run():  # needed ones first
        needing |= (
            {node.key} if any(needed.key in needing for needed in node.needs.values()) else set()
        )
    others = [node.label for node in plan.to_run() if node.key not in needing]
    assert others, "there is nothing else to do"
    ran = [line.split()[:3] for line in fakes.executions()]
    assert ran[len(others)] == first.label.split(), "it was waited for before the others were done"
    assert len(fakes.executions()) == len(set(fakes.executions())) == summary.done


class Dying(InlinePool):
    """Its first nodes die: here while they run, elsewhere before they begin. `most` says how
    many ran alone at once.
    """

    jobs = 2

    def __init__(self, local: bool, deaths: int) -> None:
        self.local, self.deaths, self.most = local, deaths, 0
        self.asked, self.single = [], []

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        self.asked.append(job.kind)
        if len(self.asked) > self.deaths:
            return super().submit(job)
        if self.local:
            Layout(Path(job.root)).running(job.run_id, job.key).write_text("{}")
        result: Future[NodeResult] = Future()
        result.set_exception(WorkersDied("ModuleNotFoundError"))
        return result

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        if not self.local:
            return self.submit(job)
        result: Future[NodeResult] = Future()
        self.single.append(result)
        self.most = max(self.most, sum(not each.done() for each in self.single))
        threading.Timer(0.1, lambda: result.set_result(execute_here(job))).start()
        return result


def test_what_ran_when_a_worker_was_killed_runs_again_with_nothing_beside_it(
    fakes, small_spec, tmp_path
):
    pool = Dying(local=True, deaths=2)
    assert run(small_spec, tmp_path / "results", pool).complete
    assert (len(pool.single), pool.most) == (2, 1)


def test_workers_elsewhere_that_cannot_begin_are_asked_twice_and_say_why(
    fakes, small_spec, tmp_path
):
    pool = Dying(local=False, deaths=99)
    failed = run(small_spec, tmp_path / "results", pool).failed
    assert pool.asked == ["expert"] * 4
    assert {result.message for _, result in failed} == {
        "its process ended twice: ModuleNotFoundError"
    }


def test_nodes_elsewhere_have_one_thread_whatever_this_machine_has(
    fakes, small_spec, tmp_path, monkeypatch
):
    monkeypatch.setattr("wasp_cli.run.session.cores", lambda: 64)
    monkeypatch.setattr("wasp_cli.run.session.pool_of", lambda *_: Dying(local=False, deaths=0))
    run_spec(load(small_spec, ["methods=[]"]), tmp_path / "results", RunOptions(jobs=2))
    manifests = [
        json.loads(path.read_text()) for path in tmp_path.glob("results/store/*/*/_manifest.json")
    ]
    assert {manifest["provenance"]["threads"] for manifest in manifests} == {1}


# One node in a worker, and worker processes under the signals that a terminal sends to the whole
# group.


@pytest.fixture
def job(fakes, small_spec, tmp_path) -> NodeJob:
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    run_id = new_run(layout, loaded, plan)
    layout.journal(run_id).touch()  # by which a worker sees that it is in the right folder
    return job_of(layout, run_id, plan.to_run()[0])


def test_what_c_libraries_print_goes_to_the_log(job, capfd, monkeypatch):
    monkeypatch.setattr(
        Fake, "run", lambda self, job: {"written": os.write(1, b"one") + os.write(2, b"two")}
    )
    result = execute(job)
    assert result.summary == {"written": 6}
    begun, ended = Path(result.log).read_text(encoding="utf-8").splitlines()
    assert begun.startswith(f"{job.label}: begun 20")
    assert ended.startswith(f"onetwo{job.label}: done in "), (
        "a log says when the node began and ended, also where nothing is printed"
    )
    os.write(1, b"restored")
    assert capfd.readouterr() == ("restored", "")


def test_a_result_of_changed_source_is_not_published(job):
    result = execute(replace(job, sources={**job.sources, "wasp_cli.config": "0" * 12}))
    assert result.state == "failed"
    assert result.message == "the source changed during the run: wasp_cli.config"
    assert not exists(Layout(Path(job.root)), job.kind, job.key)


@pytest.mark.parametrize(("told", "state"), [(None, "done"), ([1], "failed")])
def test_a_stage_may_tell_nothing_and_no_list(told, state, job, monkeypatch):
    monkeypatch.setattr(Fake, "run", lambda self, job: told)
    result = execute(job)
    assert (result.state, result.summary) == (state, {})


def test_numbers_of_numpy_and_nested_ones_become_plain():
    summary = {"a": np.float32(0.5), "b": [np.int64(2), float("inf")], "c": {"d": True}}
    assert worker.finite(summary) == {"a": 0.5, "b": [2, None], "c": {"d": True}}


def test_an_order_that_cannot_even_start_fails_without_raising(job, tmp_path):
    (tmp_path / "file").write_text("")
    assert execute(replace(job, root=str(tmp_path / "file"))).state == "unseen"
    log = Layout(Path(job.root)).log(job.run_id, job.label, job.key)
    log.mkdir()
    result = execute(job)
    assert result.state == "failed"
    assert "IsADirectoryError" in result.message


def test_a_half_written_heartbeat_goes_with_the_whole_one(tmp_path):
    """A process can be killed between writing the next heartbeat and giving it its name."""
    ours, partial, other = (
        tmp_path / name for name in ("f077.json", ".f077.json-8848987e", ".f078.json-8848987e")
    )
    for path in (ours, partial, other):
        path.write_text("{}", encoding="utf-8")
    forget(ours)
    forget(ours)
    assert sorted(tmp_path.iterdir()) == [other]


MASK = "import signal; print(sorted(signal.pthread_sigmask(signal.SIG_BLOCK, [])))"


def test_a_process_that_has_just_started_is_not_ended_by_ctrl_c():
    with signals_wait():
        process = subprocess.Popen(
            [sys.executable, "-c", MASK], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
    assert not set(SIGNALS) & signal.pthread_sigmask(signal.SIG_BLOCK, [])
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=600)
    assert (process.returncode, errors) == (0, "")
    assert all(number.name in out for number in SIGNALS)


def test_a_worker_that_is_ready_has_no_signals_waiting():
    code = f"from wasp_cli.run.pools.local import start_worker; start_worker({os.getpid()}); {MASK}"
    with signals_wait():
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=True
        )
    assert done.stdout.strip() == "[]"


# A look at the first episodes of every cell before the whole.


METHODS = {"human", "ida", "wasp", "expert"}
"""Of the small spec."""


def loaded_with(spec: Path, limit: int | None, *settings: str) -> Loaded:
    return limited(load(spec, ("episodes=30", *settings)), limit)


def planned(loaded: Loaded, layout: Layout) -> Plan:
    return plan_against(lay_out(loaded.spec), layout)


def carried_out(loaded: Loaded, layout: Layout) -> dict[str, dict[str, Any]]:
    """Compute what is missing; returns the manifests of the cells of this run by label."""
    layout.prepare()
    plan = planned(loaded, layout)
    assert Runner(layout, new_run(layout, loaded, plan), InlinePool()).run(plan).complete
    manifests = [
        json.loads(layout.manifest(node.kind, node.key).read_text())
        for node in plan.to_run()
        if node.kind == "evaluate"
    ]
    return {manifest["label"]: manifest for manifest in manifests}


def test_a_limited_cell_is_not_the_whole_one_and_the_whole_one_goes_on_from_it(
    fakes, small_spec, layout
):
    look, all_ = loaded_with(small_spec, 10), loaded_with(small_spec, None)
    first = carried_out(look, layout)
    assert {manifest["config"]["episodes"] for manifest in first.values()} == {10}
    assert not any("earlier" in manifest["provenance"] for manifest in first.values())
    assert planned(look, layout).to_run() == []

    plan = planned(all_, layout)
    cells = {node.key for node in plan.to_run() if node.kind == "evaluate"}
    assert cells == plan.begun.keys()
    # nothing is trained again
    assert {node.kind for node in plan.to_run()} <= {"evaluate", "counterfactual"}
    whole = carried_out(all_, layout)
    assert whole.keys() == first.keys()
    for label, manifest in whole.items():
        assert manifest["config"]["episodes"] == 30
        assert manifest["key"] != first[label]["key"]
        assert manifest["provenance"]["earlier"] == first[label]["key"]
    again = planned(all_, layout)
    assert again.to_run() == []
    assert again.seconds.keys().isdisjoint(node.sort for _, node in again.grid.cells), (
        "a part of a cell was taken for its time"
    )


def test_less_than_a_batch_of_a_cell_is_no_beginning(fakes, small_spec, layout):
    carried_out(loaded_with(small_spec, 9), layout)
    assert not planned(loaded_with(small_spec, None), layout).begun
    carried_out(loaded_with(small_spec, 11), layout)
    assert planned(loaded_with(small_spec, None), layout).begun


@pytest.mark.parametrize(
    ("setting", "methods"),
    [
        ("evaluate.safe_cost=25.0", METHODS),
        ("side_by_side=5", set()),
        ("evaluate.safe_cost=3.0", set()),
        ("wasp.candidates=9", METHODS - {"wasp"}),
    ],
)
def test_a_cell_that_differs_in_anything_else_is_no_beginning(
    setting, methods, fakes, small_spec, layout
):
    carried_out(loaded_with(small_spec, 10), layout)
    plan = planned(loaded_with(small_spec, None, setting), layout)
    assert {node.axes["method"] for node in plan.to_run() if node.key in plan.begun} == methods


# What the surroundings of a run can do to it: folders that cannot be read, readers that go away,
# plugins that break.


def test_results_that_cannot_be_read_are_refused(tmp_path, monkeypatch):
    with pytest.raises(StoreError, match="file name too long"):
        results_of(tmp_path / ("x" * 300))
    monkeypatch.setattr(
        "wasp_cli.cells.runs.os.scandir",
        Mock(side_effect=PermissionError(13, "Permission denied")),
    )
    with pytest.raises(StoreError, match="permission denied"):
        results_of(tmp_path)


def test_a_run_that_a_full_disk_ends_before_it_begins_leaves_nothing(
    small_spec, tmp_path, monkeypatch
):
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    monkeypatch.setattr(
        "wasp_cli.run.record.write_record", Mock(side_effect=OSError(28, "No space left on device"))
    )
    with pytest.raises(StoreError, match="no space left on device"):
        new_run(layout, loaded, plan)
    assert not [*layout.runs.glob("*")]


def test_changed_source_explains_a_failure(fakes, job):
    fakes.set(behave={"goal1": "raise"})
    result = execute(
        replace(job, sources={**job.sources, "wasp_cli.config": "0" * 12}), own_process=False
    )
    assert result.message == "the source changed during the run: wasp_cli.config"
    assert "ZeroDivisionError" in Path(result.log).read_text(encoding="utf-8")
    fakes.set(behave={"goal1": "refuse"})
    result = execute(
        replace(job, sources={**job.sources, "not_on_this_machine": "0" * 12}), own_process=False
    )
    assert result.message == "the loss is not finite", (
        "an error that says what to do about an absent module stands"
    )


def test_a_reader_that_goes_away_does_not_change_how_a_run_ends(fakes, small_spec, tmp_path):
    fakes.set(behave={"s1 critics": "refuse"})
    reader, writer = os.pipe()
    os.close(reader)
    command = [
        sys.executable,
        "tests/run/fake_wasp.py",
        "run",
        small_spec,
        "--results",
        tmp_path / "results",
        "-j",
        "0",
    ]
    done = subprocess.run(
        command,
        cwd=ROOT,
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        timeout=600,
        check=False,
    )
    os.close(writer)
    assert done.returncode == 1
    assert "1 failed:" in done.stderr
    assert "Traceback" not in done.stderr
    assert "BrokenPipe" not in done.stderr
