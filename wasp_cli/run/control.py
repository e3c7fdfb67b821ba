"""What is asked of a run from another terminal: to pause, to go on, to take nodes back. It is asked through files in the run's folder.

So it reaches runs of any backend, on any machine that sees the folder; a run looks for them twice a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.plan.recorded import PlannedRun, named_run, planned_runs
from wasp_cli.run.watch import ENDS, events_of, state_of
from wasp_cli.store.find import matching
from wasp_cli.store.layout import Layout
from wasp_cli.store.reached import reached


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
        return _cancel(layout, runs, " ".join(node.split()))
    return [f"{run.spec}: {_paused(layout, run) if action == 'pause' else _resumed(layout, run)} (run {run.run_id})" for run in runs]


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


def _paused(layout: Layout, run: PlannedRun) -> str:
    layout.pause(run.run_id).touch()
    return "paused; running nodes finish"


def _resumed(layout: Layout, run: PlannedRun) -> str:
    try:
        layout.pause(run.run_id).unlink()
    except FileNotFoundError:
        return "was not paused"
    return "goes on"


def _cancel(layout: Layout, runs: Sequence[PlannedRun], text: str) -> list[str]:
    """Take a node back from every run that has it yet to compute, or computes it now."""
    planned = [node for run in runs for node in run.nodes.values() if node.runs]
    named = {node.key: node for node in matching(planned, text)}
    if not named:
        labels = {node.label for node in planned}
        raise UnknownName("node", text, labels, f"no run that goes on computes '{text}'", otherwise="wasp status names the nodes")
    if len(named) > 1:
        lines = "\n".join(f"  {node.key}  {node.label}" for node in list(named.values())[:10])
        raise UsageError(f"'{text}' names several nodes:\n{lines}", "give the first characters of one of these keys")
    ((key, node),) = named.items()
    taken_back = []
    for run in runs:
        ended = {str(event.get("key")) for event in events_of(layout, run.run_id) if event.get("event") in ENDS}
        if key in run.nodes and run.nodes[key].runs and key not in ended:
            layout.cancelled(run.run_id).mkdir(exist_ok=True)
            layout.cancel(run.run_id, key).touch()
            count = len(_dependents(run, key) - ended)
            also = f", and {count} that {'need' if count > 1 else 'needs'} it" if count else ""
            taken_back.append(f"{node.label} is taken back{also} (run {run.run_id})")
    if not taken_back:
        raise UsageError(f"'{node.label}' has ended", "wasp status shows what runs")
    return taken_back


def _dependents(run: PlannedRun, key: str) -> set[str]:
    """The keys of what needs a node, through others too."""
    return reached([key], lambda needed: [other.key for other in run.nodes.values() if other.runs and needed in other.needs]) - {key}
