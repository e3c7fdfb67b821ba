"""`wasp status` and `wasp logs`: how far runs are, and what their nodes printed."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.options import print_json
from wasp_cli.cli.parameters import flag
from wasp_cli.console import out
from wasp_cli.errors import StoreError


@command("wasp status", "watch -n 5 wasp status results/", "wasp status --json | jq '.[0]'")
def status(
    results: options.Folder, run: options.RunOption = None, json: options.JsonOption = False
) -> None:
    """Show active runs, or the latest: progress, time left.

    It reads what a run writes to the results folder, so it also works from another terminal, and
    after a run was killed.
    """
    from wasp_cli.cells.runs import named_run, planned_runs, results_of
    from wasp_cli.run.status import as_json, show_status
    from wasp_cli.run.watch import shown_runs, state_of

    layout = results_of(results.path)
    runs = planned_runs(layout)
    if not runs:
        hint = "wasp run SPEC --results DIR writes there, and copies published results"
        raise StoreError(f"no results in '{layout.root}': it holds no runs", hint)
    states = shown_runs(layout, runs) if run is None else [state_of(layout, named_run(runs, run))]
    if json:
        print_json(as_json(states))
    else:
        show_status(states, out())


@command(
    "wasp logs 'goal1 s1 wasp laggy=0.7'",
    "tail -f \"$(wasp logs 'goal1 s1 wasp laggy=0.7' --path)\"",
    codes="0 done, 1 the results cannot be read, 2 no such node",
)
def logs(
    node: options.NodeArgument,
    place: options.Whereabouts,
    path: Annotated[bool, flag("--path", "Print the path of the log, not the log.")] = False,
) -> None:
    """Print the log of a node.

    When it began and ended, what it printed, why it failed.
    """
    from wasp_cli.cells.runs import named_run, planned_runs, results_of
    from wasp_cli.run.logs import find_log, write_log

    layout = results_of(place.results)
    runs = planned_runs(layout)
    if place.run is not None:  # the logs of a sweep's values are in the folder of the sweep
        named = named_run(planned_runs(layout, values=True), place.run)
        runs = [
            replace(run, plans=named.plans)
            for run in runs
            if named.run_id in (run.run_id, *run.values)
        ]
    log = find_log(layout, runs, node)
    if path:
        print(log.path)
    else:
        write_log(log, sys.stdout)
