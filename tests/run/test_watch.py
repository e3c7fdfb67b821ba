"""How far a run is, from its folder alone."""

import os
import shutil
import threading
from concurrent.futures import Future
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from tests.run.fake_stages import Fake
from tests.run.harness import prepared, run
from tests.run.recorded import START, at, dead_pid, key, planned, process, write_run
from wasp_cli.cells.runs import planned_runs
from wasp_cli.errors import StoreError
from wasp_cli.run import runner
from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.pools.local import InlinePool
from wasp_cli.run.process import boot_id
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner
from wasp_cli.run.status import pace
from wasp_cli.run.watch import RunState, moment, shown_runs, state_of
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held_if_free
from wasp_cli.store.plain import read_json_lines
from wasp_cli.store.records import write_record

NODES = [
    planned(0, "a", "cached"),
    planned(1, "b", seconds=100.0),
    planned(2, "c", needs=[1], seconds=60.0),
    planned(3, "d", needs=[2], seconds=40.0),
    planned(4, "e", "failed"),
    planned(5, "f", needs=[4]),
]
HERE = process(os.getpid())
RUN = "20260501-120000-small-0001"


def started(**facts: Any) -> tuple[float, str, dict[str, Any]]:
    return (0, "run started", {"nodes": 5, "jobs": 2, **HERE, **facts})


def ended(
    event: str, number: int, seconds: float, **facts: Any
) -> tuple[float, str, dict[str, Any]]:
    return (
        seconds,
        event,
        {"key": key(number), "label": f"node {number}", "seconds": 1.0, **facts},
    )


def only(layout: Layout, seconds: float = 120.0) -> RunState:
    (run,) = planned_runs(layout)
    return state_of(layout, run, START + timedelta(seconds=seconds))


def test_a_run_that_goes_on(layout):
    events = [
        started(),
        ended("done", 1, 60),
        ended("retry", 4, 70, message="killed", attempt=1),
        ended("failed", 4, 90, message="no memory", log="/x/e.log"),
        ended("blocked", 5, 90, by=key(4)),
    ]
    running = {
        2: {
            "label": "c",
            "kind": "expert",
            "share": 0.25,
            "text": "step 5",
            "started": at(60),
            "at": at(119),
            "memory_mb": 512,
            **HERE,
        },
        1: {"label": "b", "share": 1.0, "text": "left behind by a node that has ended", **HERE},
    }
    write_run(layout, RUN, NODES, events, running)
    state = only(layout)
    assert (state.state, state.spec, state.total) == ("running", "small", 5)
    assert (
        state.done,
        state.shared,
        len(state.failed),
        state.blocked,
        state.running,
        state.waiting,
    ) == (1, 0, 1, 1, 1, 1)
    assert (state.retried, state.draining) == (1, False)
    assert (state.failed[0].label, state.failed[0].message, state.failed[0].log) == (
        "node 4",
        "no memory",
        "/x/e.log",
    )
    (node,) = state.active
    assert (node.label, node.kind, node.share, node.text, node.memory_mb, node.gone) == (
        "c",
        "expert",
        0.25,
        "step 5",
        512.0,
        False,
    )
    assert (node.started, node.seen) == (moment(at(60)), moment(at(119)))
    # d waits for c, however many workers there are
    assert state.left_seconds == pytest.approx(0.75 * 60 + 40)
    assert state.unknown == 0


def test_processes_that_share_the_steps_of_an_environment_shorten_what_is_left(layout):
    # of 100 s an environment takes 60, which two processes share
    stepping = {"seconds": 60.0, "rows": 8}
    nodes = [
        planned(0, "a", "cached"),
        planned(1, "b", seconds=100.0, stepping=stepping),
        planned(2, "c", needs=[1], seconds=10.0),
    ]
    write_run(layout, RUN, nodes, [started(threads=2)])
    assert only(layout).left_seconds == pytest.approx(70 + 10)


def test_a_plan_without_threads_or_shared_steps_counts_one_process(layout):
    nodes = [planned(1, "b", seconds=100.0, stepping={"seconds": 60.0, "rows": 8})]
    write_run(layout, RUN, nodes, [started()])
    assert only(layout).left_seconds == pytest.approx(100.0)


def in_new_environment(number: int, label: str, kind: str, seconds: float) -> dict[str, Any]:
    node = planned(number, label, needs=[number - 1], seconds=seconds)
    return {**node, "kind": kind, "task": "my_env:My-v0", "decisions": 1000}


def test_the_first_node_in_a_new_environment_tells_how_long_the_others_take(layout):
    nodes = [
        planned(0, "a", "cached"),
        in_new_environment(1, "b", "expert", 10.0),
        in_new_environment(2, "c", "dataset", 20.0),
        in_new_environment(3, "d", "evaluate", 30.0),
    ]
    write_run(layout, RUN, nodes, [started()])
    state = only(layout)
    assert (state.left_seconds, state.unmeasured) == (pytest.approx(60.0), 3000)
    assert "not counting 3,000 decisions" in pace(state)
    # 50 s more than planned for a thousand decisions
    events = [started(), (60, "done", {"key": key(1), "label": "b", "seconds": 60.0})]
    write_run(layout, "20260501-130000-small-0002", nodes, events)
    newest, _ = planned_runs(layout)
    state = state_of(layout, newest, START + timedelta(seconds=61))
    assert state.left_seconds == pytest.approx(20 + 50 + 30 + 50)
    assert state.unmeasured == 0
    assert "not counting" not in pace(state)


@pytest.mark.parametrize(
    ("facts", "state"),
    [
        ({}, "running"),
        ({"pid": dead_pid()}, "died"),
        ({"boot": "of yesterday"}, "died" if boot_id() else "running"),
        ({"host": "elsewhere"}, "running"),  # cannot be seen from here
        ({"host": "elsewhere", "locked": True}, "died"),
    ],
)
def test_the_death_of_a_run_shows(facts, state, layout):
    write_run(layout, RUN, NODES, [started(**facts), ended("done", 1, 60)])
    found = only(layout)
    assert found.state == state
    assert (found.ended == moment(at(60))) == (state == "died")
    assert (found.left_seconds is None) == (state == "died")


def test_a_run_of_another_container_is_known_by_its_lock(layout):
    write_run(
        layout,
        RUN,
        NODES,
        [started(pid=dead_pid(), locked=True)],
        {1: {"label": "b", **process(dead_pid())}},
    )
    with held_if_free(layout.journal(RUN)), held_if_free(layout.lock(key(1))):
        state = only(layout)
        assert (state.state, state.running) == ("running", 1)
    assert only(layout).state == "died"


def test_the_runs_that_go_on_are_shown_or_else_the_last(layout):
    over = [started(), (9, "run ended", {})]
    write_run(layout, "20260501-120000-a-0001", NODES, over, spec="a")
    write_run(layout, "20260501-130000-b-0002", NODES, over, spec="b")
    assert [state.run_id[-4:] for state in shown_runs(layout, planned_runs(layout))] == ["0002"]
    for number, spec in ((3, "a"), (4, "a"), (5, "b")):
        write_run(
            layout, f"20260501-14000{number}-{spec}-000{number}", NODES, [started()], spec=spec
        )
    write_run(layout, "20260501-150000-c-0006", NODES, over, spec="c")
    assert [state.run_id[-4:] for state in shown_runs(layout, planned_runs(layout))] == [
        "0005",
        "0004",
        "0003",
    ], "also two of one spec"


def test_a_sweep_is_one_run(layout):
    for number in (1, 2):
        write_run(
            layout,
            f"20260501-120000-s-value-000{number}",
            [planned(number, f"n{number}")],
            spec="s-value",
        )
    write_run(layout, "20260501-120001-s-sweep-0003", [], [started(nodes=2), ended("done", 1, 4)])
    folder = layout.run("20260501-120001-s-sweep-0003")
    (folder / "plan.json").unlink()
    values = [{"value": number, "run": f"20260501-120000-s-value-000{number}"} for number in (1, 2)]
    write_record(folder / "sweep.json", {"spec": "s", "setting": "wasp.tau_c", "values": values})
    state = only(layout)
    assert (state.spec, state.total, state.done) == ("s --vary wasp.tau_c", 2, 1)


def test_what_is_odd_in_a_folder_is_left_out(layout):
    odd: list[Any] = [
        7,
        {**planned(1, "x"), "key": "../../x"},
        {"key": key(1)},
        {**planned(1, "x"), "needs": 5},
    ]
    odd.append({**planned(1, "x"), "seconds": 10**400})
    for number, entry in enumerate(odd):
        write_run(
            layout, f"20260501-110000-small-100{number}", [planned(2, "c"), entry], [started()]
        )
    events = [started(nodes="many", jobs=-3), (1, "done", {"key": 5, "at": "never"})]
    write_run(layout, RUN, [planned(2, "c", needs=[99]), planned(3, "d")], events)
    folder = layout.run(RUN) / "running"
    (folder / "nonsense.json").write_text("{}")
    (folder / f"{key(2)}.json").write_text(
        '{"share": "all", "label": ["x"], "pid": "x", "memory_mb": true, "started": 5}'
    )
    state = only(layout)
    assert sorted(planned_runs(layout)[0].nodes) == [key(2), key(3)]
    assert [(node.label, node.share, node.started) for node in state.active] == [
        (key(2), 0.0, None)
    ]


def test_a_run_without_workers_has_no_time_left_until_they_are_back(layout):
    events = [
        started(backend="dask"),
        (10.0, "workers gone", {"backend": "dask", "start": "dask worker tcp://a:1"}),
    ]
    write_run(layout, RUN, [planned(1, "b", seconds=10.0)], events)
    state = only(layout)
    assert (
        state.deserted
        == "all dask workers are gone; the run waits, and goes on when one is there: dask "
        "worker tcp://a:1"
    )
    assert (state.state, state.left_seconds) == ("running", None)
    events.append((20.0, "workers back", {"backend": "dask", "start": None}))
    write_run(layout, "20260501-130000-small-0002", [planned(1, "b", seconds=10.0)], events)
    newest = next(iter(planned_runs(layout)))
    assert (
        state_of(layout, newest, START).deserted,
        state_of(layout, newest, START).left_seconds,
    ) == ("", 10.0)


# The results folder as workers see it: another one under the same path, one that shows files late,
# one that is moved away.


class Elsewhere(InlinePool):
    """A worker whose results folder is another one, though its path is the same for the one who
    asks.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        return super().submit(replace(job, root=str(self.folder)))


class Late(InlinePool):
    """A worker whose artifacts are seen here after a while."""

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        found = super().submit(job)
        place = Layout(Path(job.root)).artifact(job.kind, job.key)
        hidden = place.with_name("hidden")
        os.replace(place, hidden)
        threading.Timer(0.02, os.replace, (hidden, place)).start()
        return found


def test_a_worker_that_does_not_see_the_folder_refuses_and_makes_none(fakes, small_spec, tmp_path):
    with pytest.raises(StoreError, match="does not see the results folder") as refused:
        run(small_spec, tmp_path / "results", Elsewhere(tmp_path / "local"))
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
    assert not {event["event"] for event in read_json_lines(layout.journal(run_id))} & {
        "done",
        "shared",
    }
    assert not list(layout.store.glob("*/*"))


def test_an_artifact_may_arrive_late(fakes, small_spec, tmp_path):
    small_spec.write_text(small_spec.read_text().replace("[0, 1]", "[0]"))
    summary = run(small_spec, tmp_path / "results", Late())
    assert summary.complete
    assert summary.done == len(fakes.executions())


@pytest.mark.parametrize("moment", ["while a node runs", "between two nodes"])
def test_a_folder_that_is_moved_away_is_not_made_again(
    moment, fakes, small_spec, tmp_path, monkeypatch
):
    results, moved = tmp_path / "results", tmp_path / "moved"
    place, name = (Fake, "run") if moment == "while a node runs" else (InlinePool, "submit")
    real = getattr(place, name)

    def away(self: Any, job: Any) -> Any:
        if len(fakes.executions()) == 2:
            os.replace(results, moved)
        return real(self, job)

    monkeypatch.setattr(place, name, away)
    with pytest.raises(StoreError, match="does not see the results folder"):
        run(small_spec, results)
    assert not results.exists()
    monkeypatch.setattr(place, name, real)
    os.replace(moved, results)
    assert run(small_spec, results).complete
    assert len(fakes.executions()) == len(set(fakes.executions())) + (moment == "while a node runs")
