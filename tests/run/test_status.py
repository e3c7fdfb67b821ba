"""`wasp status` and `wasp logs`, beside a real run and on folders written by hand; which run is
the newest, and until when it goes on.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from tests.commands import run_here
from tests.run.harness import ROOT, finished, keys_of, run, start, wait_until
from tests.run.recorded import dead_pid, key, planned, process, write_run
from wasp_cli.cells.runs import last_runs, run_ids
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import is_held
from wasp_cli.store.records import read_record

RUN = "20260501-120000-small-0001"


def status(layout: Layout, *options: str) -> str:
    return run_here("status", layout.root, *options, columns=120, code=0).stdout


def test_a_run_that_died(layout):
    events = [
        (0.0, "run started", {"nodes": 3, **process(dead_pid())}),
        (60.0, "done", {"key": key(1), "label": "a"}),
    ]
    events.append(
        (61.0, "failed", {"key": key(2), "label": "b", "message": "no [memory]", "log": "/x/b.log"})
    )
    write_run(
        layout,
        RUN,
        [planned(n, "abc"[n - 1]) for n in (1, 2, 3)],
        events,
        {3: {"label": "c", "share": 0.5, "text": "step 7"}},
    )
    lines = status(layout).splitlines()
    assert (
        lines[0]
        == "small  died; its last event was 2026-05-01 12:01 UTC, after 1 min 01 s (started "
        "2026-05-01 12:00 UTC)"
    )
    assert lines[1] == f"run {RUN}"
    assert lines[2] == "[" + "=" * 13 + " " * 27 + "] 1 of 3 done, 1 failed, 1 not computed"
    assert re.fullmatch(r"  c +50% +gone +step 7 *", lines[3])
    assert lines[4:] == ["FAILED b: no [memory]", "       log: /x/b.log"]


def test_a_run_that_goes_on_is_seen_from_elsewhere_and_its_death_too(fakes, small_spec, layout):
    fakes.set(free=6, behave={"s1 ida_q": "refuse"})

    def halfway() -> bool:
        records = [read_record(path) or {} for path in layout.root.glob("runs/*/running/*.json")]
        return len(fakes.executions()) >= 8 and [record.get("share") for record in records] == [
            0.5,
            0.5,
        ]

    process = start("run", small_spec, "--results", layout.root, "-j", "2")
    try:
        wait_until(halfway)
        (state,) = json.loads(status(layout, "--json"))
        assert (state["spec"], state["state"], state["total"], state["running"]) == (
            "small",
            "running",
            36,
            2,
        )
        assert state["finished"] + state["running"] + state["waiting"] == 36
        assert {node["share"] for node in state["active"]} == {0.5}
        assert is_held(next(layout.root.glob("runs/*/journal.jsonl")))
        text = status(layout)
        assert "2 running" in text
        label = state["active"][0]["label"]
        assert f"  {label}  " in text

        def log() -> list[str]:
            shown = run_here("logs", label, "--results", layout.root, columns=80, code=0)
            return shown.stdout.splitlines()

        wait_until(lambda: len(log()) > 1)
        assert log()[1].startswith(f"fake {' '.join(label.split()[:3])}")
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        wait_until(lambda: any(layout.root.glob("runs/*/stop")))
        os.killpg(process.pid, signal.SIGTERM)
        process.communicate(timeout=600)
    assert json.loads(status(layout, "--json"))[0]["state"] == "interrupted"


def test_the_log_of_any_node(fakes, small_spec, results):
    fakes.set(behave={"s0 ida_q": "refuse"})
    run(small_spec, results)
    for label in (
        "goal1 s0 world_model",
        "goal1 s0 ida_q",
        "GOAL1 s1 human noisy=0.2",
        "goal1 human noisy=0.2 seed 1",
    ):
        done = run_here("logs", label, "--results", results, columns=80, code=0)
        begun, printed, *_ = done.stdout.splitlines()
        assert ": begun 20" in begun
        assert printed.startswith("fake goal1 s")
    assert (
        "error: the loss is not finite"
        in run_here("logs", "goal1 s0 ida_q", "--results", results, columns=80).stdout
    )
    path = Path(
        run_here(
            "logs", "goal1 s0 ida_q", "--path", "--results", results, columns=20
        ).stdout.rstrip("\n")
    )
    assert path.is_file()
    assert run_here(
        "logs", path.stem.rpartition("-")[2], "--path", "--results", results, columns=20
    ).stdout.rstrip("\n") == str(path)
    assert (
        "did you mean 'goal1 s0 ida_q'"
        in run_here("logs", "goal1 s0 ida_p", "--results", results, columns=200, code=2).stderr
    )


def test_the_newest_log_is_shown_and_an_older_one_by_its_run(layout):
    for run_id, number in (
        (RUN, 1),
        ("20260501-130000-small-0002", 1),
        ("20260501-140000-small-0003", 2),
    ):
        write_run(layout, run_id, [planned(number, "a"), planned(7, "b", "cached")])
        layout.log(run_id, "a", key(number)).write_text(f"of {run_id}\n")
    layout.log(RUN, "b", key(7)).write_text("of b\n")

    def log(*arguments: str) -> str:
        return run_here("logs", *arguments, "--results", layout.root, columns=80, code=0).stdout

    assert log("a") == "of 20260501-140000-small-0003\n"
    assert log(key(1)) == "of 20260501-130000-small-0002\n"
    assert log(key(1), "--run", "0001") == f"of {RUN}\n"
    assert log("b") == "of b\n"  # computed in the first run; later ones found it there
    write_run(layout, "20260501-150000-small-0004", [planned(2, "a")])
    # it found what the third run computed
    layout.log("20260501-150000-small-0004", "a", key(2)).touch()
    assert log("a") == "of 20260501-140000-small-0003\n"
    assert log("a", "--run", "0004") == ""
    write_run(layout, "20260501-160000-4-0005", [planned(7, "b", "cached")], spec="4")
    assert (
        "no log of 'a'"
        in run_here("logs", "a", "--run", "4", "--results", layout.root, columns=80, code=2).stderr
    ), "4 is a spec"
    assert (
        "'0000' names 3 nodes"
        in run_here("logs", "0000", "--results", layout.root, columns=80, code=2).stderr
    )


def test_a_label_names_the_node_of_the_newest_run_that_left_one(layout):
    """A run whose number does not read is the oldest, whatever its name says."""
    orders = {
        "20300101-120000-small-0001": "no number",
        "20260503-120000-small-0002": "1\n",
        "20260502-120000-small-0003": "2\n",
    }
    for number, run_id in enumerate(orders, 1):
        write_run(layout, run_id, [planned(number, "a")])
        layout.order(run_id).write_text(orders[run_id])
        if number < 3:
            manifest = {"key": key(number), "kind": "expert", "label": "a"}
            commit(layout, "expert", key(number), staging_folder(layout, key(number)), manifest)
    for options, number in (([], 2), (["--run", "0001"], 1)):
        done = run_here(
            "show", "a", *options, "--json", "--results", layout.root, columns=80, code=0
        )
        assert json.loads(done.stdout)["key"] == key(number)
    shutil.rmtree(layout.runs)
    assert (
        "'a' names 2 nodes"
        in run_here("show", "a", "--results", layout.root, columns=80, code=2).stderr
    )
    run_here("show", key(2), "--results", layout.root, columns=80, code=0)


def test_a_log_commands_no_terminal(layout):
    """A pipe gets a log as it is; a terminal its colours, and of a bar that redraws itself the
    last state.
    """
    write_run(layout, RUN, [planned(1, "a")])
    layout.log(RUN, "a", key(1)).write_bytes(
        b"\x1b]0;title\x07\x1b[31mred\x1b[0m \xff\n10 %\r20 %\nend"
    )
    arguments = ["logs", "a", "--results", str(layout.root)]
    assert (
        run_here(*arguments, columns=80).stdout
        == "\x1b]0;title\x07\x1b[31mred\x1b[0m \ufffd\n10 %\r20 %\nend"
    )
    reader, writer = os.openpty()
    subprocess.run(
        [sys.executable, "-m", "wasp_cli", *arguments], stdout=writer, check=True, cwd=ROOT
    )
    os.close(writer)
    shown = b""
    with suppress(OSError):  # how Linux says that a terminal has no writer any more
        while chunk := os.read(reader, 4096):  # so little stays in the terminal until it is read
            shown += chunk
    os.close(reader)
    assert (
        shown.decode().replace("\r\n", "\n")
        == "\ufffd]0;title\ufffd\x1b[31mred\x1b[0m \ufffd\n20 %\nend"
    )


def test_a_clock_that_was_ahead_makes_no_run_the_newest(fakes, small_spec, other_spec, results):
    run(small_spec, results)
    layout = Layout(results)
    (first,) = run_ids(layout)
    ahead = "20300101-000000-small-0001"
    os.rename(layout.run(first), layout.run(ahead))
    future = time.time() + 10**8
    os.utime(layout.run(ahead), (future, future))
    run(other_spec, results)
    (newest,) = set(run_ids(layout)) - {ahead}
    assert run_ids(layout) == [newest, ahead]
    last = last_runs(layout)
    assert ({name: run.run_id for name, run in last.runs.items()}, last.damaged) == (
        {"small": newest},
        (),
    )
    assert (
        json.loads(run_here("status", results, "--json", columns=80).stdout)[0]["run_id"] == newest
    )
    run_here("gc", results, "--yes", columns=80, code=0)
    assert finished(results) == keys_of(other_spec, results)


def test_what_a_run_reports_on_stays_until_its_report_is_written(
    fakes, small_spec, other_spec, tmp_path
):
    results, gate = tmp_path / "results", tmp_path / "report now"
    fakes.set(report=str(gate))
    process = start("run", small_spec, "--results", results, "-j", "0")
    try:
        wait_until(
            lambda: any(
                "run ended" in path.read_text() for path in results.glob("runs/*/journal.jsonl")
            )
        )
        before = keys_of(small_spec, results)
        run(other_spec, results)
        for _ in range(2):
            run_here("gc", results, "--yes", "--runs", columns=80, code=0)
        assert before <= finished(results)
    finally:
        gate.touch()
        output = process.communicate(timeout=600)
    assert process.returncode == 0, output
    run_here("gc", results, "--yes", columns=80)
    assert finished(results) == keys_of(other_spec, results)
