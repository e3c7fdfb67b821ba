"""A run from elsewhere: without its terminal, and what is asked of it from another one: to pause, to go on, to take nodes back.

A run without its terminal is a child in a session of its own, which says where it is as soon as its folder is there. What is asked is files
in the run's folder, so that it reaches runs of any backend, on any machine that sees the folder; a run looks for them twice a second.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from wasp_cli.errors import UnknownName, UsageError, first
from wasp_cli.plan.recorded import PlannedRun, named_run, planned_runs
from wasp_cli.run.watch import ENDS, events_of, state_of
from wasp_cli.store.find import SHOWN, matching
from wasp_cli.store.layout import Layout
from wasp_cli.store.reached import reached

TOLD = "WASP_DETACHED"  # names, to the child, the file in which it says where it is
POLL_SECONDS = 0.05


def control(layout: Layout, action: Literal["pause", "resume", "cancel"], node: str | None, name: str | None) -> list[str]:
    """Ask the runs that go on, or the one that is named, for something; return what each does now, in words.

    `node` is what is cancelled: a label, or the beginning of a key.
    """
    if node is None and action == "cancel":
        raise UsageError("cancel which node?", "wasp control cancel NODE; wasp status shows what runs")
    if node is not None and action != "cancel":
        raise UsageError(f"'{node}' is too much: {action} is for whole runs", "--run ID names a run, --results DIR a results folder")
    planned = planned_runs(layout)
    meant = planned if name is None else [named_run(planned, name)]
    runs = [run for run in meant if state_of(layout, run).state == "running"]
    if not runs:
        what = "no run goes on" if name is None else f"the run '{meant[0].run_id}' is over"
        raise UsageError(f"{what} in '{layout.root}'", "wasp status shows the runs")
    if node is not None:
        return _cancel(layout, runs, " ".join(node.split()))
    answers = []
    for run in runs:
        pause = layout.pause(run.run_id)
        if action == "pause":
            pause.touch()
            answer = "paused; running nodes finish"
        else:
            answer = "goes on" if pause.exists() else "was not paused"
            pause.unlink(missing_ok=True)
        answers.append(f"{run.spec}: {answer} (run {run.run_id})")
    return answers


def _cancel(layout: Layout, runs: Sequence[PlannedRun], text: str) -> list[str]:
    """Take a node back from every run that has it yet to compute, or computes it now."""
    planned = [node for run in runs for node in run.nodes.values() if node.runs]
    named = {node.key: node for node in matching(planned, text)}
    if not named:
        labels = {node.label for node in planned}
        raise UnknownName("node", text, labels, f"no run that goes on computes '{text}'", otherwise="wasp status names the nodes")
    if len(named) > 1:
        lines = [f"'{text}' names several nodes:", *first([f"  {node.key}  {node.label}" for node in named.values()], SHOWN)]
        raise UsageError("\n".join(lines), "give the first characters of one of these keys")
    ((key, node),) = named.items()
    taken_back = []
    for run in runs:
        ended = {str(event.get("key")) for event in events_of(layout, run.run_id) if event.get("event") in ENDS}
        if key in run.nodes and run.nodes[key].runs and key not in ended:
            layout.cancelled(run.run_id).mkdir(exist_ok=True)
            layout.cancel(run.run_id, key).touch()
            count = len(_with_dependents(run, key) - {key} - ended)
            also = f", and {count} that {'need' if count > 1 else 'needs'} it" if count else ""
            taken_back.append(f"{node.label} is taken back{also} (run {run.run_id})")
    if not taken_back:
        raise UsageError(f"'{node.label}' has ended", "wasp status shows what runs")
    return taken_back


def _with_dependents(run: PlannedRun, key: str) -> set[str]:
    """The keys of a node and of what needs it, through others too."""
    return reached([key], lambda needed: [node.key for node in run.nodes.values() if node.runs and needed in node.needs])


def detached(arguments: Sequence[str]) -> tuple[Mapping[str, Any] | None, int, str]:
    """Start this program again without the terminal, and wait until its run has begun or it has ended.

    Returns what it says of its run (None where it ended without one), its exit code (0 while it goes on), and what it printed until then.
    """
    # As a module where it was started so: the folder of a package is no place to import from.
    own = Path(sys.argv[0])
    program = ["-m", "wasp_cli"] if own.name == "__main__.py" else [str(own)]
    with tempfile.TemporaryDirectory(prefix="wasp-") as folder:
        told, log = Path(folder) / "run.json", Path(folder) / "terminal.log"
        with log.open("w", encoding="utf-8") as stream:
            process = subprocess.Popen(
                [sys.executable, "-P", *program, *arguments],
                stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, start_new_session=True, env={**os.environ, TOLD: str(told)},
            )  # fmt: skip
        while not told.exists() and process.poll() is None:
            time.sleep(POLL_SECONDS)
        said = json.loads(told.read_text(encoding="utf-8")) if told.exists() else None
        return said, process.poll() or 0, log.read_text(encoding="utf-8", errors="replace")


def announce(layout: Layout, run_id: str, spec: str) -> None:
    """Say where this run is, where somebody has started it without a terminal and waits to hear; from then on it prints to its folder."""
    told = os.environ.pop(TOLD, None)
    if told is None:
        return
    log = layout.run(run_id).absolute() / "terminal.log"
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    for number in (1, 2):
        os.dup2(descriptor, number)
    os.close(descriptor)
    said = {"spec": spec, "run": run_id, "folder": str(log.parent), "pid": os.getpid(), "log": str(log)}
    written = Path(told + ".part")
    written.write_text(json.dumps(said), encoding="utf-8")
    written.rename(told)  # whole, or not there
