"""`wasp tasks` and `wasp tasks show`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli import completion as complete
from wasp_cli.cli.options import JsonOption, argument, expected_errors, option, print_json

tasks_app = typer.Typer(
    invoke_without_command=True,
    help="List the tasks, or show one.",
    epilog="[bold]wasp tasks[/]   ·   [bold]wasp tasks show goal1 --seed 3[/]   ·   [bold]wasp tasks --json | jq '.[].gym_id'[/]",
)


@tasks_app.callback()
@expected_errors
def tasks(context: typer.Context, json: JsonOption = False) -> None:
    """List the tasks with their spaces, cost sources and limits, or show one (wasp tasks show)."""
    if context.invoked_subcommand is not None:
        if json:
            from wasp_cli.errors import UsageError

            raise UsageError("--json is for the list of tasks; a task is shown as a picture", "wasp tasks --json")
        return
    from dataclasses import asdict

    from wasp_cli.console import out, say
    from wasp_cli.report.tables.tasks import task_table
    from wasp_cli.tasks.describe import describe

    found = describe()
    if json:
        print_json([asdict(task) for task in found])
        return
    out().print(task_table(found))
    say("Any gymnasium id is a task too: docs/own_task.md")


@tasks_app.command(
    "show",
    epilog="[bold]wasp tasks show goal1 --seed 3 --out map.png[/]   ·   [bold]wasp tasks show my_pkg:MyEnv-v0[/]\n\n"
    "Exit codes: 0 done, 1 the environment fails or the file cannot be written, 2 usage.",
)
@expected_errors
def show_task(
    task: Annotated[str, argument(metavar="ID", help="A task (goal1) or a gymnasium id (my_pkg:MyEnv-v0).", autocompletion=complete.tasks)],
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**32 - 1, metavar="N", help="Seed of the layout.")] = 0,
    out: Annotated[Path | None, option("--out", metavar="PNG", help="File of the picture. (default: <task>_seed<N>.png)")] = None,
    steps: Annotated[
        int, typer.Option("--steps", min=0, metavar="N", help="Also show the first N decision steps, up to the end of the episode.")
    ] = 0,
) -> None:
    """Draw a layout: the map from above and both camera images."""
    from wasp_cli.console import say
    from wasp_cli.tasks.sheet import draw_sheet

    path = draw_sheet(task, seed, steps, out)
    say(str(path))
