"""The results folder as workers see it: another one under the same path, one that shows files late, one that is moved away."""

import os
import shutil
import threading
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.run.fake_stages import Fake
from tests.run.harness import prepared, run
from wasp_cli.errors import StoreError
from wasp_cli.run import runner
from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.pool import InlinePool
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner
from wasp_cli.run.worker import execute
from wasp_cli.stages.base import Job
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import read_json_lines


class Elsewhere(InlinePool):
    """A worker whose results folder is another one, though its path is the same for the one who asks."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        done: Future[NodeResult] = Future()
        done.set_result(execute(replace(job, root=str(self.folder)), own_process=False))
        return done


class Late(InlinePool):
    """A worker whose artifacts are seen here after a while."""

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        found = super().submit(job)
        place = Layout(Path(job.root)).artifact(job.kind, job.key)
        hidden = place.with_name("hidden")
        os.replace(place, hidden)
        threading.Timer(0.2, os.replace, (hidden, place)).start()
        return found


def test_a_worker_that_does_not_see_the_folder_refuses_and_makes_none(fakes, small_spec, tmp_path):
    with pytest.raises(StoreError, match="does not see the results folder") as refused:
        run(small_spec, tmp_path / "results", Elsewhere(tmp_path / "local"))
    assert refused.value.hint is not None
    assert "under the same path" in refused.value.hint
    assert not (tmp_path / "local").exists()
    assert fakes.executions() == []


def test_a_node_is_done_only_when_its_artifact_is_here(fakes, small_spec, tmp_path, monkeypatch):
    """The worker has a copy of the folder, the journal too."""
    monkeypatch.setattr(runner, "ARRIVAL_SECONDS", 0.0)
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    run_id = new_run(layout, loaded, plan)
    runner_here = Runner(layout, run_id, Elsewhere(tmp_path / "local"))
    shutil.copytree(layout.root, tmp_path / "local")
    summary = runner_here.run(plan)
    assert fakes.executions(), "the worker computed, and told that it was done"
    assert summary.done == summary.shared == 0
    assert "it is not in" in summary.failed[0][1].message
    assert not {event["event"] for event in read_json_lines(layout.journal(run_id))} & {"done", "shared"}
    assert not list(layout.store.glob("*/*"))


def test_an_artifact_may_arrive_late(fakes, small_spec, tmp_path):
    summary = run(small_spec, tmp_path / "results", Late())
    assert summary.complete
    assert summary.done == len(fakes.executions())


@pytest.mark.parametrize("moment", ["while a node runs", "between two nodes"])
def test_a_folder_that_is_moved_away_is_not_made_again(moment, fakes, small_spec, tmp_path, monkeypatch):
    results, moved = tmp_path / "results", tmp_path / "moved"
    real = Fake.run

    def away(self: Fake, job: Job) -> Mapping[str, Any]:
        if len(fakes.executions()) == 2:
            os.replace(results, moved)
        return real(self, job)

    class Moving(InlinePool):
        def submit(self, job: NodeJob) -> Future[NodeResult]:
            if len(fakes.executions()) == 2:
                os.replace(results, moved)
            return super().submit(job)

    if moment == "while a node runs":
        monkeypatch.setattr(Fake, "run", away)
    with pytest.raises(StoreError, match="does not see the results folder"):
        run(small_spec, results, InlinePool() if moment == "while a node runs" else Moving())
    assert not results.exists()
    monkeypatch.setattr(Fake, "run", real)
    os.replace(moved, results)
    assert run(small_spec, results).complete
    assert len(fakes.executions()) == len(set(fakes.executions())) + (moment == "while a node runs")
