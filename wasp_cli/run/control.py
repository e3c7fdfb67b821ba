"""What is asked of a run from another terminal: to pause, to go on, to take nodes back. It is asked through files in the run's folder.

So it reaches runs of any backend, on any machine that sees the folder; a run looks for them twice a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.plan.recorded import PlannedNode, PlannedRun, named_run, planned_runs
from wasp_cli.run.watch import ENDS, events_of, state_of
from wasp_cli.store.find import begins, same_label
from wasp_cli.store.layout import Layout


def control(layout: Layout, action: Literal["pause", "resume", "cancel"], node: str | None, name: str | None) -> list[str]:
    """Ask the runs that go on, or the one that is named, for something; return what each does now, in words.

    Args:
        layout: the results folder.
        action: what is asked for.
        node: what is cancelled: a label, or the beginning of a key.
        name: of a run; None: all that go on.

    Raises:
        UsageError: no run goes on, there is a node too many or none to cancel, or the node cannot be taken back.
        UnknownName: there is no such run or node.
    """
    if node is None and action == "cancel":
        raise UsageError("cancel which node?", "wasp control cancel NODE; wasp status shows what runs")
    if node is not None and action != "cancel":
        raise UsageError(f"'{node}' is too much: {action} is for whole runs", "--run ID names a run, --results DIR a results folder")
    runs = live_runs(layout, planned_runs(layout), name)
    if node is not None:
        return [_told(taken) for taken in cancel(layout, runs, node)]
    if action == "resume":
        return [f"{run.spec}: {'goes on' if resume(layout, run) else 'was not paused'} (run {run.run_id})" for run in runs]
    for run in runs:
        pause(layout, run)
    return [f"{run.spec}: paused; running nodes finish (run {run.run_id})" for run in runs]


def live_runs(layout: Layout, runs: Sequence[PlannedRun], name: str | None) -> list[PlannedRun]:
    """Return the runs that go on now, newest first; the named one alone where there is a name.

    Raises:
        UsageError: none goes on, or the named one does not.
        UnknownName: there is no run of this name.
    """
    meant = list(runs) if name is None else [named_run(runs, name)]
    live = [run for run in meant if state_of(layout, run).state == "running"]
    if not live:
        what = "no run goes on" if name is None else f"the run '{meant[0].run_id}' is over"
        raise UsageError(f"{what} in '{layout.root}'", "wasp status shows the runs")
    return live


def pause(layout: Layout, run: PlannedRun) -> None:
    """Let a run begin nothing new; what runs goes on to its end."""
    layout.pause(run.run_id).touch()


def resume(layout: Layout, run: PlannedRun) -> bool:
    """Let a run go on; return whether it was paused."""
    paused = layout.pause(run.run_id).exists()
    layout.pause(run.run_id).unlink(missing_ok=True)
    return paused


@dataclass(frozen=True)
class TakenBack:
    """A node that a run will not compute, and what it will not compute either, since it needs it."""

    run: PlannedRun
    node: PlannedNode
    dependents: tuple[PlannedNode, ...]


def cancel(layout: Layout, runs: Sequence[PlannedRun], text: str) -> list[TakenBack]:
    """Take a node back from every run that has it yet to compute, or computes it now.

    Args:
        layout: the results folder.
        runs: runs that go on.
        text: a label, or the beginning of a key.

    Raises:
        UsageError: the text names several nodes, or one that has ended.
        UnknownName: it names none.
    """
    text = " ".join(text.split())
    planned = [(run, node) for run in runs for node in run.nodes.values() if node.runs]
    named = [(run, node) for run, node in planned if begins(node.key, text)]
    named = named or [(run, node) for run, node in planned if same_label(node.label, text)]
    if not named:
        labels = {node.label for _, node in planned}
        raise UnknownName("node", text, labels, f"no run that goes on computes '{text}'", otherwise="wasp status names the nodes")
    if len({node.key for _, node in named}) > 1:
        lines = "\n".join(f"  {node.key}  {node.label}" for _, node in named[:10])
        raise UsageError(f"'{text}' names several nodes:\n{lines}", "give the first characters of one of these keys")
    open_ = [(run, node) for run, node in named if node.key not in _ended(layout, run)]
    if not open_:
        raise UsageError(f"'{named[0][1].label}' has ended", "wasp status shows what runs")
    for run, node in open_:
        layout.cancelled(run.run_id).mkdir(exist_ok=True)
        layout.cancel(run.run_id, node.key).touch()
    return [TakenBack(run, node, _dependents(run, node, _ended(layout, run))) for run, node in open_]


def _ended(layout: Layout, run: PlannedRun) -> set[str]:
    return {str(event.get("key")) for event in events_of(layout, run.run_id) if event.get("event") in ENDS}


def _dependents(run: PlannedRun, node: PlannedNode, ended: set[str]) -> tuple[PlannedNode, ...]:
    """What needs a node, through others too."""
    lost = {node.key: node}
    while more := {
        key: other for key, other in run.nodes.items() if other.runs and key not in lost and not lost.keys().isdisjoint(other.needs)
    }:
        lost |= more
    return tuple(other for key, other in lost.items() if key != node.key and key not in ended)


def _told(taken: TakenBack) -> str:
    count = len(taken.dependents)
    also = f", and {count} that {'need' if count > 1 else 'needs'} it" if count else ""
    return f"{taken.node.label} is taken back{also} (run {taken.run.run_id})"
