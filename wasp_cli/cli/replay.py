"""`wasp replay`: the video of an episode or of a decision."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.options import print_json
from wasp_cli.cli.parameters import flag, option
from wasp_cli.console import following, plain, say
from wasp_cli.errors import UsageError
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from wasp_cli.store.find import FoundCell


@command(
    "wasp replay 'goal1 s1 wasp laggy=0.7' --episode 0",
    "wasp replay 'goal1 s1 ida laggy=0.7' -e 3 --every 2 --out a.webp",
    codes="0 done, 1 the episode cannot be replayed, 2 no such cell, episode or step, or an "
    "unsupported file format",
)
def replay(
    cell: options.StoredCellArgument,
    episode: options.EpisodeOption,
    place: options.Whereabouts,
    step: Annotated[
        int | None,
        option(
            "T",
            "One decision, with the executed action and with the command. (default: the "
            "whole episode)",
            "--step",
            "-s",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        option(
            "FILE",
            "A .gif, .apng, .webp or .png (with --step: a still). (default: a GIF here)",
            "--out",
            "-o",
        ),
    ] = None,
    every: Annotated[
        int | None, option("N", "Decisions per frame. (default: at most 125 frames)", min=1)
    ] = None,
    json: Annotated[bool, flag("--json", "With --step: print the numbers as JSON.")] = False,
) -> None:
    """Show an episode, or one decision, as a video.

    With map, cameras, imagined futures and gates. The cell is replayed with its own models, bit for
    bit; a replay that differs from the recording is an error. With --step, the task goes on twice
    from one decision: once with the executed action, once with the command. Then both follow the
    operator. The first episode of a published cell is played alone: what happens is the same, and
    what is imagined to rounding.

    This runs the task. For a gymnasium environment it imports the module that the cell names: only
    do so if you trust it.
    """
    from wasp_cli.cells.runs import keys_of
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.slim import without_steps
    from wasp_cli.video.replay import replay as written
    from wasp_cli.video.replay import replay_step

    if json and step is None:
        raise UsageError(
            "--json needs --step",
            "for the numbers of an episode: wasp explain CELL --episode E --json",
        )
    if every is not None and step is not None:
        raise UsageError(
            "--every cannot be used with --step",
            "the video of one decision has a frame for every decision",
        )
    layout = Layout(place.results.absolute())
    stored = find_cell(layout, cell, keys_of(layout, place.run, cell))
    with following("replay") as progress:
        if step is None:
            path, made = written(layout, stored, episode, out, every, progress)
        else:
            path, verdict = replay_step(layout, stored, episode, step, out, progress)
    if step is None:
        say(f"{path}: {made.frames} frames")
        if without_steps(stored.manifest):
            say(
                "what happens is as recorded; the episode is played alone, so that what is "
                "imagined may round differently"
            )
    elif json:
        print_json(asdict(verdict) | {"cell": stored.label, "key": stored.key, "file": str(path)})
    else:
        say(*verdict.lines(), str(path))
    if not json:
        _say_address(place.results, stored, episode, step)


def _say_address(results: Path, cell: FoundCell, episode: int, step: int | None) -> None:
    """Say which command shows a place in a browser; not of a file that lies outside of the
    results.
    """
    from wasp_cli.report.render import cell_address, open_command

    if cell.key is not None and cell.path.absolute().parent.parent == Layout(
        results.absolute()
    ).kind("evaluate"):
        plain(f"in a browser: {open_command(results, cell_address(cell.key[:8], episode, step))}")
