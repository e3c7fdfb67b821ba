"""`wasp replay`: an episode as a video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.options import ResultsOption, expected_errors

replay_app = typer.Typer()


@replay_app.command(
    epilog="[bold]wasp replay 'goal1 s1 wasp laggy=0.7' --episode 0[/]   ·   [bold]wasp replay 611a4993 -e 3 --every 2 --out a.webp[/]\n\n"
    "Exit codes: 0 done, 1 rows or models cannot be read or played again, 2 no such cell, episode or step, or no file of a video."
)
@expected_errors
def replay(
    cell: Annotated[
        str,
        typer.Argument(
            metavar="CELL", help="The beginning of a key, a label ('goal1 s0 wasp laggy=0.7'), or a cell.parquet.", show_default=False
        ),
    ],
    episode: Annotated[int, typer.Option("--episode", "-e", metavar="E", help="Which episode of the cell.", show_default=False)],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="A .gif, .png (animated) or .webp. (default: a GIF here)", show_default=False),
    ] = None,
    every: Annotated[
        int | None,
        typer.Option("--every", min=1, metavar="N", help="Decisions between two frames. (default: at most 125 frames)", show_default=False),
    ] = None,
    results: ResultsOption = Path("results"),
) -> None:
    """Show an episode as a video: the map, both cameras, what the world model imagined, and the gates.

    The cell is played again with its own models, bit for bit, and refused if it does not come out as it was recorded.
    """
    from wasp_cli.console import following
    from wasp_cli.console import out as stdout
    from wasp_cli.report.replay import replay as written
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.layout import Layout

    layout = Layout(results.absolute())
    with following("replay") as progress:
        path, made = written(layout, find_cell(layout, cell), episode, out, every, progress)
    stdout().print(f"{path}: {made.frames} frames", soft_wrap=True)
