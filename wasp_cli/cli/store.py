"""The commands that move, remove or check results: `wasp gc`, `wasp publish` and `wasp verify`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli.options import (
    JobsOption,
    ResultsArgument,
    ResultsOption,
    SelectOption,
    SetOption,
    SpecArgument,
    TaskOption,
    expected_errors,
    flag,
    option,
    parse_folder,
    results_folder,
)

PANEL = "Maintenance"

store_app = typer.Typer()


@store_app.command(
    rich_help_panel=PANEL,
    epilog="[bold]wasp gc --dry-run[/]   ·   [bold]wasp gc --keep specs/table1.yaml --older-than 30[/]\n\n"
    "Exit codes: 0 done, 1 the results cannot be read, 2 usage, 3 invalid spec.",
)
@expected_errors
def gc(
    folder: ResultsArgument = None,
    results: ResultsOption = Path("results"),
    keep: Annotated[
        list[Path] | None, option("--keep", metavar="SPEC", help="Also keep what this spec needs, as it is now (repeatable).")
    ] = None,
    older_than: Annotated[float | None, option("--older-than", min=0, metavar="DAYS", help="Only what is older than this.")] = None,
    runs: Annotated[bool, flag("--runs", help="Also remove run folders and their logs, except the newest of each spec.")] = False,
    dry_run: Annotated[bool, flag("--dry-run", help="Only show what would be removed.")] = False,
    yes: Annotated[bool, flag("--yes", "-y", help="Do not ask. Required without a terminal.")] = False,
) -> None:
    """Remove results that no spec needs.

    Kept is what the newest run of each spec needs, what active runs need, what a person drove, what a note is about, and everything that
    these were computed from.
    """
    import sys
    import time

    from wasp_cli.console import out
    from wasp_cli.report.notes import notes_of
    from wasp_cli.run.reach import kept_keys, remove_unreached, unreached
    from wasp_cli.run.record import results_of
    from wasp_cli.run.show import removed_line, show_rubbish

    layout = results_of(results_folder(folder, results))
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


@store_app.command(
    rich_help_panel=PANEL,
    epilog="[bold]wasp publish specs/quickstart.yaml --dry-run[/]   ·   "
    "[bold]wasp publish specs/table1.yaml --select 'task=goal1' --select 'stage=world_model'[/]\n\n"
    "Exit codes: 0 done, 1 a result is missing, damaged or names this machine, 2 usage, 3 invalid spec.",
)
@expected_errors
def publish(
    spec: SpecArgument,
    results: ResultsOption = Path("results"),
    to: Annotated[
        Path | None,
        option("--to", metavar="DIR", parser=parse_folder, help="Destination folder. (default: published/ in the results folder)"),
    ] = None,
    task: TaskOption = None,
    select: SelectOption = None,
    largest: Annotated[float, typer.Option("--largest", min=0, metavar="MB", help="Leave out larger artifacts.")] = 8.0,
    reuse: Annotated[
        str, typer.Option("--reuse", metavar="none|published|DIR", help="none: only what this code computed; otherwise as for wasp run.")
    ] = "none",
    half: Annotated[bool, flag("--half", help="Weights in half precision: half the size.")] = False,
    steps: Annotated[
        int | None,
        typer.Option("--steps", min=0, metavar="N", help="Of each cell only the steps of the first N episodes. (default: all)"),
    ] = None,
    no_images: Annotated[bool, flag("--no-images", help="Leave out the images of diagnostics.")] = False,
    dry_run: Annotated[bool, flag("--dry-run", help="Only show what would be published.")] = False,
    set_: SetOption = None,
) -> None:
    """Copy the results of a spec, with its report, to a folder for git.

    Later runs use them instead of training (--reuse published). What is published already and unchanged stays as it is.
    """
    from wasp_cli.console import out, say, waiting_aloud
    from wasp_cli.run.publish import carry_publication, publication
    from wasp_cli.run.record import results_of
    from wasp_cli.run.session import restricted
    from wasp_cli.run.show import show_publication
    from wasp_cli.spec.load import load
    from wasp_cli.store.layout import Layout
    from wasp_cli.store.lock import held
    from wasp_cli.store.slim import Slimming

    loaded = restricted(load(spec, set_ or ()), task)
    layout = results_of(results.absolute())
    target = Layout(layout.published if to is None else to.absolute())
    # Meanwhile nothing is removed.
    with held(layout.planning, waiting_aloud("waiting for wasp gc"), shared=True):
        planned = publication(loaded.spec, layout, target, select or (), largest * 1e6, reuse)
        show_publication(planned, largest * 1e6, out())
        if dry_run:
            return
        carry_publication(planned, loaded.spec, layout, target, Slimming(half, steps, images=not no_images))
    say(f"published in {target.root}")


@store_app.command(
    rich_help_panel=PANEL,
    epilog="[bold]wasp verify results/published --cells 30 --seed 7[/]\n\n"
    "Exit codes: 0 all are the same, 1 some are not, or the folder cannot be read, 2 usage.",
)
@expected_errors
def verify(
    folder: ResultsArgument = None,
    results: ResultsOption = Path("results"),
    cells: Annotated[int, typer.Option("--cells", min=1, metavar="N", help="Cells that are drawn.")] = 30,
    seed: Annotated[int, typer.Option("--seed", min=0, metavar="N", help="Seed of the draw.")] = 0,
    jobs: JobsOption = None,
) -> None:
    """Compute a sample of cells again from the models beside them, and compare to the bit.

    Nothing in the folder changes. Wall times are not compared.
    """
    from wasp_cli.console import out, say
    from wasp_cli.run.session import cores
    from wasp_cli.run.verify import draw, show_answer
    from wasp_cli.run.verify import verify as verified
    from wasp_cli.store.layout import Layout

    layout = Layout(results_folder(folder, results).absolute())
    drawn = draw(layout, cells, seed)
    say(f"{len(drawn.cells)} of {drawn.of} cells are computed again; {drawn.others} others cannot be: their models are not in the folder")
    same = 0
    for answer in verified(layout, drawn.cells, cores() if jobs is None else max(1, jobs)):
        same += not answer.differing
        show_answer(answer, out())
    out().print(f"{same} of {len(drawn.cells)} cells are the same to the bit", markup=False)
    if same < len(drawn.cells):
        raise typer.Exit(1)
