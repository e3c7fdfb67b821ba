"""`wasp show` and `wasp gc`: what the store holds of a node, and what nobody needs of it any more."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.options import NodeArgument, ResultsOption, expected_errors, print_json

store_app = typer.Typer()


@store_app.command(
    epilog="[bold]wasp show 611a4993[/]   ·   [bold]wasp show 'goal1 s0 world_model' --json | jq .provenance.git[/]\n\n"
    "Exit codes: 0 done, 1 the manifest cannot be read, 2 no such node."
)
@expected_errors
def show(
    cell: NodeArgument,
    results: ResultsOption = Path("results"),
    json: Annotated[bool, typer.Option("--json", help="The same facts for machines.")] = False,
) -> None:
    """Show what is known of a node: numbers, configuration, what it read, its files, where it came from, why it failed."""
    from dataclasses import asdict

    from wasp_cli.console import out
    from wasp_cli.report.node import node_facts
    from wasp_cli.report.node_text import node_lines
    from wasp_cli.run.record import results_of
    from wasp_cli.store.find import find_node

    layout = results_of(results)
    facts = node_facts(layout, find_node(layout, cell))
    if json:
        print_json(asdict(facts))
        return
    for line in node_lines(facts):
        out().print(line, soft_wrap=True)
