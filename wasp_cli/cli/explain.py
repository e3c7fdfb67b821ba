"""`wasp show` and `wasp explain`: what is known of a node, of an episode, and of a decision."""

from __future__ import annotations

import shlex
from typing import Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.options import print_json
from wasp_cli.cli.parameters import option
from wasp_cli.cli.replay import _say_address
from wasp_cli.console import out, say
from wasp_cli.store.layout import Layout

WIDTH = 140


@command(
    "wasp show 'goal1 s1 world_model'",
    "wasp show 'goal1 s1 world_model' --json | jq .provenance.git",
    codes="0 done, 1 the manifest cannot be read, 2 no such node",
)
def show(
    node: options.NodeArgument, place: options.Whereabouts, json: options.JsonOption = False
) -> None:
    """Show a node: numbers, inputs, provenance, last failure."""
    from wasp_cli.cells.runs import keys_of
    from wasp_cli.report.node import node_facts, node_lines
    from wasp_cli.store.find import find_node

    layout = Layout(place.results)
    facts = node_facts(layout, find_node(layout, node, keys_of(layout, place.run, node)))
    if json:
        print_json(facts)
    else:
        say(*node_lines(facts))


@command(
    "wasp explain 'goal1 s1 wasp laggy=0.7' --episode 3",
    "wasp explain 'goal1 s1 wasp laggy=0.7' --episode 3 --step 57",
    codes="0 done, 1 the rows cannot be read, 2 no such cell, episode or step",
)
def explain(
    cell: options.StoredCellArgument,
    episode: options.EpisodeOption,
    place: options.Whereabouts,
    step: Annotated[
        int | None,
        option(
            "T", "One decision, with its plan. (default: a summary of the episode)", "--step", "-s"
        ),
    ] = None,
    json: options.JsonOption = False,
) -> None:
    """Explain what an assistant did, and why.

    In an episode, or at one decision: which gate fired and by how much, what was planned, and what
    then happened. Only stored rows are read.
    """
    from wasp_cli.cells.runs import keys_of
    from wasp_cli.report.explain.episode import read_episode
    from wasp_cli.report.explain.facts import decision_json, episode_json
    from wasp_cli.report.explain.text import decision_lines, episode_lines
    from wasp_cli.store.find import find_cell

    layout = Layout(place.results)
    stored = read_episode(find_cell(layout, cell, keys_of(layout, place.run, cell)), episode)
    if json:
        print_json(episode_json(stored) if step is None else decision_json(stored, step))
        return
    width = out().width if out().is_terminal else WIDTH
    again = "wasp explain " + shlex.quote(
        stored.cell.key[:8] if stored.cell.key else str(stored.cell.path)
    )
    if place.results != options.RESULTS:
        again += f" --results {shlex.quote(str(place.results))}"
    if step is None:
        say(*episode_lines(stored, width, again))
    else:
        say(*decision_lines(stored, step, width))
    _say_address(place.results, stored.cell, episode, step)
