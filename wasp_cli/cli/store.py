"""`wasp show` and `wasp gc`: what the store holds of a node, and what nobody needs of it any more."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli.options import NodeArgument, ResultsArgument, ResultsOption, expected_errors, print_json

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
    from wasp_cli.report.node import node_facts, node_lines
    from wasp_cli.run.record import results_of
    from wasp_cli.store.find import find_node

    layout = results_of(results)
    facts = node_facts(layout, find_node(layout, cell))
    if json:
        print_json(asdict(facts))
        return
    for line in node_lines(facts):
        out().print(line, soft_wrap=True)


@store_app.command(
    epilog="[bold]wasp gc --dry-run[/]   ·   [bold]wasp gc --keep specs/table1.yaml --older-than 30[/]\n\n"
    "Exit codes: 0 done, 1 the results cannot be read, 2 usage, 3 invalid spec."
)
@expected_errors
def gc(
    folder: ResultsArgument = Path("results"),
    keep: Annotated[
        list[Path] | None,
        typer.Option("--keep", metavar="SPEC", help="Also keep what this spec asks for as it is now. Repeatable.", show_default=False),
    ] = None,
    older_than: Annotated[
        float | None, typer.Option("--older-than", min=0, metavar="DAYS", help="Only what was written so long ago.", show_default=False)
    ] = None,
    runs: Annotated[bool, typer.Option("--runs", help="Also folders of runs, with their logs, but the newest of each spec.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would go.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask. Needed where there is no terminal.")] = False,
) -> None:
    """Remove what no spec reaches.

    Kept is what the newest run of each spec reaches, every run that is not over, and what either was computed from.
    """
    import sys
    import time

    from wasp_cli.console import out
    from wasp_cli.run.reach import kept_keys, remove_unreached, unreached
    from wasp_cli.run.record import results_of
    from wasp_cli.run.show_gc import removed_line, show_rubbish

    layout = results_of(folder)
    kept, before = kept_keys(layout, keep or ()), None if older_than is None else time.time() - older_than * 86400
    found = unreached(layout, kept, runs=runs, before=before)
    show_rubbish(found, out())
    if not found or dry_run:
        return
    if not yes and not (sys.stdin.isatty() and sys.stdout.isatty()):
        out().print("nothing was removed: say --yes where there is no terminal to ask on", markup=False)
    elif yes or typer.confirm("Remove all of it?"):
        done = remove_unreached(layout, kept, found, runs=runs, before=before)
        out().print(removed_line(*done), markup=False)
