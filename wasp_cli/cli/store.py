"""The commands that move, remove or check results: `wasp gc`, `wasp publish` and `wasp verify`."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli.command import command
from wasp_cli.cli.options import Folder, JobsOption, SelectOption, SizedSpec, directory, flag, option
from wasp_cli.console import out, say, waiting_aloud
from wasp_cli.store.layout import Layout


@command(
    "wasp gc --dry-run",
    "wasp gc --keep specs/table1.yaml --older-than 30",
    codes="0 done, 1 the results cannot be read, 2 usage, 3 invalid spec",
)
def gc(
    results: Folder,
    keep: Annotated[list[Path] | None, option("SPEC", "Also keep what this spec needs, as it is now (repeatable).")] = None,
    older_than: Annotated[float | None, option("DAYS", "Only what is older than this.", min=0)] = None,
    runs: Annotated[bool, flag("--runs", "Also remove run folders and their logs, except the newest of each spec.")] = False,
    dry_run: Annotated[bool, flag("--dry-run", "Only show what would be removed.")] = False,
    yes: Annotated[bool, flag("--yes", "Do not ask. Required without a terminal.", "-y")] = False,
) -> None:
    """Remove results that no spec needs.

    Kept is what the newest run of each spec needs, what active runs need, what a person drove, what a note is about, and everything that
    these were computed from.
    """
    from wasp_cli.report.notes import notes_of
    from wasp_cli.run.reach import kept_keys, remove_unreached, unreached
    from wasp_cli.run.record import results_of
    from wasp_cli.run.show import removed_line, show_rubbish

    layout = results_of(results.path)
    kept, before = kept_keys(layout, keep or ()), None if older_than is None else time.time() - older_than * 86400
    kept |= {note.key for note in notes_of(layout)}
    rubbish = unreached(layout, kept, runs=runs, before=before)
    show_rubbish(rubbish, out())
    if not rubbish or dry_run:
        return
    if not yes and not (sys.stdin.isatty() and sys.stdout.isatty()):
        out().print("nothing was removed: there is no terminal to ask on, and --yes was not given", markup=False)
    elif yes or typer.confirm("Remove all of it?"):
        kept |= {note.key for note in notes_of(layout)}  # somebody may have written one since
        done = remove_unreached(layout, kept, rubbish, runs=runs, before=before)
        out().print(removed_line(*done), markup=False)


@command(
    "wasp publish specs/quickstart.yaml --dry-run",
    "wasp publish specs/table1.yaml --select 'task=goal1' --select 'stage=world_model'",
    codes="0 done, 1 a result is missing, damaged or names this machine, 2 usage, 3 invalid spec",
)
def publish(
    asked: SizedSpec,
    to: Annotated[Path | None, directory("Destination folder. (default: published/ in the results folder)")] = None,
    select: SelectOption = None,
    largest: Annotated[float, option("MB", "Leave out larger artifacts.", min=0)] = 8.0,
    reuse: Annotated[str, option("none|published|DIR", "none: only what this code computed; otherwise as for wasp run.")] = "none",
    half: Annotated[bool, flag("--half", "Weights in half precision: half the size.")] = False,
    steps: Annotated[int | None, option("N", "Of each cell only the steps of the first N episodes. (default: all)", min=0)] = None,
    no_images: Annotated[bool, flag("--no-images", "Leave out the images of diagnostics.")] = False,
    dry_run: Annotated[bool, flag("--dry-run", "Only show what would be published.")] = False,
) -> None:
    """Copy the results of a spec to a folder for git.

    With its report. Later runs use them instead of training (--reuse published). What is published already and unchanged stays as it is.
    """
    from wasp_cli.run.publish import carry_publication, publication
    from wasp_cli.run.record import results_of
    from wasp_cli.run.show import show_publication
    from wasp_cli.store.lock import held
    from wasp_cli.store.slim import Slimming

    spec, layout = asked.load().spec, results_of(asked.results.absolute())
    target = Layout(layout.published if to is None else to.absolute())
    # Meanwhile nothing is removed.
    with held(layout.planning, waiting_aloud("waiting for wasp gc"), shared=True):
        planned = publication(spec, layout, target, select or (), largest * 1e6, reuse)
        show_publication(planned, largest * 1e6, out())
        if dry_run:
            return
        carry_publication(planned, spec, layout, target, Slimming(half, steps, images=not no_images))
    say(f"published in {target.root}")


@command("wasp verify results/ --cells 30 --seed 7", codes="0 all are the same, 1 some are not, or the folder cannot be read, 2 usage")
def verify(
    results: Folder,
    cells: Annotated[int, option("N", "Cells that are drawn.", min=1)] = 30,
    seed: Annotated[int, option("N", "Seed of the draw.", min=0)] = 0,
    jobs: JobsOption = None,
) -> None:
    """Compute some cells again and compare to the bit.

    They are drawn, and computed from the models beside them. Nothing in the folder changes. Wall times are not compared.
    """
    from wasp_cli.run.session import cores
    from wasp_cli.run.verify import draw, show_answer
    from wasp_cli.run.verify import verify as verified

    layout = Layout(results.path.absolute())
    drawn = draw(layout, cells, seed)
    say(f"{len(drawn.cells)} of {drawn.of} cells are computed again; {drawn.others} others cannot be: their models are not in the folder")
    same = 0
    for answer in verified(layout, drawn.cells, cores() if jobs is None else max(1, jobs)):
        same += not answer.differing
        show_answer(answer, out())
    out().print(f"{same} of {len(drawn.cells)} cells are the same to the bit", markup=False)
    if same < len(drawn.cells):
        raise typer.Exit(1)
