"""`wasp gc`: results that no spec needs are removed."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.parameters import flag, option
from wasp_cli.console import out as console
from wasp_cli.console import size

DAY = 86400  # seconds


@command(
    "wasp gc --dry-run",
    "wasp gc --keep specs/table1.yaml --older-than 30",
    codes="0 done, 1 the results cannot be read, 2 usage, 3 invalid spec",
)
def gc(
    results: options.Folder,
    keep: Annotated[
        list[Path] | None,
        option("SPEC", "Also keep what this spec needs, as it is now (repeatable)."),
    ] = None,
    older_than: Annotated[
        float | None, option("DAYS", "Only what is older than this.", min=0)
    ] = None,
    runs: Annotated[
        bool,
        flag("--runs", "Also remove run folders and their logs, except the newest of each spec."),
    ] = False,
    dry_run: Annotated[bool, flag("--dry-run", "Only show what would be removed.")] = False,
    yes: Annotated[bool, flag("--yes", "Do not ask. Required without a terminal.", "-y")] = False,
) -> None:
    """Remove results that no spec needs.

    Kept is what the newest whole run of each spec needs, what later runs with --task, --method or
    --limit need, what active runs need, what a person drove, what a note is about, and everything
    that these were computed from.
    """
    from wasp_cli.cells.runs import results_of
    from wasp_cli.report.notes import notes_of
    from wasp_cli.run.reach import kept_keys, remove_unreached, show_rubbish, unreached

    layout = results_of(results.path)
    kept = kept_keys(layout, keep or ()) | {note.key for note in notes_of(layout)}
    before = None if older_than is None else time.time() - older_than * DAY
    rubbish = unreached(layout, kept, runs=runs, before=before)
    show_rubbish(rubbish, console())
    if not rubbish or dry_run:
        return
    if not yes and not (sys.stdin.isatty() and sys.stdout.isatty()):
        console().print(
            "nothing was removed: there is no terminal to ask on, and --yes was not given",
            markup=False,
        )
    elif yes or typer.confirm("Remove all of it?"):
        kept |= {note.key for note in notes_of(layout)}  # somebody may have written one since
        count, freed = remove_unreached(layout, kept, rubbish, runs=runs, before=before)
        console().print(f"{count} removed, {size(freed)} freed", markup=False)
