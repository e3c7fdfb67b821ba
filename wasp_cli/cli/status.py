"""`wasp status` and `wasp logs`: how far runs are, and what their nodes print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli.options import NodeArgument, ResultsArgument, ResultsOption, expected_errors, print_json

status_app = typer.Typer()

RunOption = Annotated[
    str | None,
    typer.Option(
        "--run", metavar="ID", help="This run, a folder name in runs/ or the end of one. (default: the newest)", show_default=False
    ),
]


@status_app.command(
    epilog="[bold]wasp status[/]   ·   [bold]watch -n 5 wasp status results/[/]   ·   [bold]wasp status --json | jq '.[0]'[/]"
)
@expected_errors
def status(
    folder: ResultsArgument = Path("results"),
    run: RunOption = None,
    json: Annotated[bool, typer.Option("--json", help="The same facts for machines.")] = False,
) -> None:
    """Say how far the runs are that go on, or else the last one.

    From what a run writes down, so also from another terminal, and after its death.
    """
    from wasp_cli.console import out
    from wasp_cli.errors import StoreError
    from wasp_cli.plan.recorded import named_run, planned_runs
    from wasp_cli.run.record import results_of
    from wasp_cli.run.show import as_json, show_status
    from wasp_cli.run.watch import shown_runs, state_of

    layout = results_of(folder)
    runs = planned_runs(layout)
    if not runs:
        raise StoreError(f"no results in '{folder}': it holds no runs", "wasp run SPEC --results DIR writes there")
    states = shown_runs(layout, runs) if run is None else [state_of(layout, named_run(runs, run))]
    if json:
        print_json(as_json(states))
    else:
        show_status(states, out())


@status_app.command(
    epilog="[bold]wasp logs 'goal1 s0 world_model'[/]   ·   [bold]tail -f $(wasp logs 611a4993 --path)[/]\n\n"
    "Exit codes: 0 done, 1 the results cannot be read, 2 no such node."
)
@expected_errors
def logs(
    cell: NodeArgument,
    run: RunOption = None,
    results: ResultsOption = Path("results"),
    path: Annotated[bool, typer.Option("--path", help="Only say where the file is.")] = False,
) -> None:
    """Print the log of a node: of an evaluation or a training, finished, failed or running."""
    import sys

    from wasp_cli.plan.recorded import named_run, planned_runs
    from wasp_cli.run.logs import find_log, write_log
    from wasp_cli.run.record import results_of

    layout = results_of(results)
    runs = planned_runs(layout)
    found = find_log(layout, runs if run is None else [named_run(runs, run)], cell)
    if path:
        print(found.path)
    else:
        write_log(found, sys.stdout)
