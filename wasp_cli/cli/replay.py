"""`wasp replay`: an episode as a video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli.options import EpisodeOption, ResultsOption, StoredCellArgument, expected_errors, print_json

replay_app = typer.Typer()


@replay_app.command(
    epilog="[bold]wasp replay 'goal1 s1 wasp laggy=0.7' --episode 0[/]   ·   [bold]wasp replay 611a4993 -e 3 --every 2 --out a.webp[/]\n\n"
    "Exit codes: 0 done, 1 rows or models cannot be read or played again, 2 no such cell, episode or step, or no file of a video."
)
@expected_errors
def replay(
    cell: StoredCellArgument,
    episode: EpisodeOption,
    step: Annotated[
        int | None,
        typer.Option(
            "--step",
            "-s",
            metavar="T",
            help="One decision: as executed and with the command alone. (default: the episode)",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="A .gif, .apng or .webp; a .png is animated too, but a still with --step. (default: a GIF here)",
            show_default=False,
        ),
    ] = None,
    every: Annotated[
        int | None,
        typer.Option("--every", min=1, metavar="N", help="Decisions between two frames. (default: at most 125 frames)", show_default=False),
    ] = None,
    results: ResultsOption = Path("results"),
    json: Annotated[bool, typer.Option("--json", help="With --step: the numbers for machines.")] = False,
) -> None:
    """Show an episode as a video: the map, both cameras, what the world model imagined, and the gates.

    The cell is played again with its own models, bit for bit, and refused if it does not come out as it was recorded. With --step, two
    branches of the real task begin at one decision: one executes what was executed, the other the command; both then follow the operator.

    This runs the task: of a cell on a gymnasium environment it imports the module that the cell names. Only do so where you trust it.
    """
    from wasp_cli.console import following
    from wasp_cli.console import out as stdout
    from wasp_cli.errors import UsageError
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.layout import Layout
    from wasp_cli.video.replay import replay as written
    from wasp_cli.video.replay_step import replay_step

    if json and step is None:
        raise UsageError("--json needs --step", "wasp explain CELL --episode E --json has the numbers of an episode")
    if every is not None and step is not None:
        raise UsageError("--every has no meaning with --step", "both branches of a decision are short: every decision of them is a frame")
    layout = Layout(results.absolute())
    found = find_cell(layout, cell)
    with following("replay") as progress:
        if step is None:
            path, made = written(layout, found, episode, out, every, progress)
        else:
            path, verdict = replay_step(layout, found, episode, step, out, progress)
    if step is None:
        stdout().print(f"{path}: {made.frames} frames", markup=False, soft_wrap=True)
    elif json:
        print_json(verdict.as_json() | {"cell": found.label, "key": found.key, "file": str(path)})
    else:
        for line in (*verdict.lines(), str(path)):
            stdout().print(line, markup=False, soft_wrap=True)
