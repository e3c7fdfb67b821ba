"""`wasp explain`: why an assistant did what it did."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli.options import EpisodeOption, ResultsOption, StoredCellArgument, expected_errors, print_json

explain_app = typer.Typer()

WIDTH = 140
"""Columns where the output is no terminal."""


@explain_app.command(
    epilog="[bold]wasp explain 611a4993 --episode 3[/]   ·   [bold]wasp explain 'goal1 s0 wasp laggy=0.7' --episode 3 --step 57[/]\n\n"
    "Exit codes: 0 done, 1 the rows cannot be read, 2 no such cell, episode or step."
)
@expected_errors
def explain(
    cell: StoredCellArgument,
    episode: EpisodeOption,
    step: Annotated[
        int | None,
        typer.Option("--step", "-s", metavar="T", help="One decision, with its plan. (default: the whole episode)", show_default=False),
    ] = None,
    results: ResultsOption = Path("results"),
    json: Annotated[bool, typer.Option("--json", help="The same facts for machines.")] = False,
) -> None:
    """Say why an assistant did what it did: over an episode, or at one decision.

    From the stored rows alone: which gate fired, by how much, what was planned, what then really happened.
    """
    from wasp_cli.console import out
    from wasp_cli.report.explain.facts import Story, as_json
    from wasp_cli.report.explain.look import look
    from wasp_cli.report.explain.look_text import look_lines
    from wasp_cli.report.explain.stored import read_episode
    from wasp_cli.report.explain.story_text import story_lines
    from wasp_cli.report.explain.tell import tell
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.layout import Layout

    stored = read_episode(find_cell(Layout(results), cell), episode)
    facts = tell(stored) if step is None else look(stored, step)
    if json:
        print_json(as_json(facts))
        return
    width = out().width if out().is_terminal else WIDTH
    again = "wasp explain " + shlex.quote(stored.cell.key[:8] if stored.cell.key else str(stored.cell.path))
    if results != Path("results"):
        again += f" --results {shlex.quote(str(results))}"
    lines = story_lines(facts, width, again) if isinstance(facts, Story) else look_lines(facts, width)
    for line in lines:
        out().print(line, soft_wrap=True)
