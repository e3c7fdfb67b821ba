"""`wasp publish`: the results of a spec in a folder for git."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.parameters import directory, flag, option
from wasp_cli.console import say, waiting_aloud
from wasp_cli.store.layout import Layout


@command(
    "wasp publish specs/quickstart.yaml --reuse published --dry-run",
    "wasp publish specs/table1.yaml --select 'task=goal1' --select 'stage=world_model'",
    codes="0 done, 1 a result is missing, damaged or names this machine, 2 usage, 3 invalid spec",
)
def publish(
    asked: options.SizedSpec,
    to: Annotated[
        Path | None, directory("Destination folder. (default: published/ in the results folder)")
    ] = None,
    select: options.SelectOption = None,
    largest: Annotated[float, option("MB", "Leave out larger artifacts.", min=0)] = 8.0,
    reuse: Annotated[
        str,
        option(
            "none|published|DIR", "none: only what this code computed; otherwise as for wasp run."
        ),
    ] = "none",
    steps: Annotated[
        int | None,
        option("N", "Of each cell only the steps of the first N episodes. (default: all)", min=0),
    ] = None,
    images: Annotated[
        bool, flag("--images/--no-images", "Publish the images of diagnostics too.")
    ] = True,
    archive: Annotated[
        Path | None,
        option(
            "FILE|DIR",
            "Also make a folder for a hub of the destination, with a card, expected numbers, "
            "checksums and licence; or an archive of it: FILE.tar.gz.",
        ),
    ] = None,
    dry_run: Annotated[bool, flag("--dry-run", "Only show what would be published.")] = False,
) -> None:
    """Copy the results of a spec to a folder for git.

    With its report. Later runs use them instead of training (--reuse published). What is published
    already and unchanged stays as it is.
    """
    from wasp_cli.cells.runs import results_of
    from wasp_cli.export.hub import require_archive, write_archive
    from wasp_cli.run.publish import carry_publication, fewer_steps, publication, show_publication
    from wasp_cli.store.lock import held
    from wasp_cli.store.slim import Slimming

    if archive is not None:
        require_archive(archive)
    spec = asked.load().spec
    layout = results_of(asked.results.absolute())
    target = Layout(layout.within(layout.published) if to is None else to.absolute())
    with ExitStack() as stack:
        # The lock keeps `wasp gc` from removing anything meanwhile, which it cannot do in a folder
        # that cannot be written.
        if not dry_run and os.access(layout.root, os.W_OK):
            wait = waiting_aloud("waiting for wasp gc")
            stack.enter_context(held(layout.planning, wait, shared=True))
        planned = publication(spec, layout, target, select or (), largest * 1e6, reuse)
        show_publication(planned, largest * 1e6)
        cut = fewer_steps(planned, target, steps)
        if cut:
            say(
                f"{cut} of the cells there have fewer steps and stay as they are: remove "
                f"them from '{target.root}' to publish more"
            )
        if dry_run:
            return
        carry_publication(planned, spec, layout, target, Slimming(steps, images=images))
    if target.root.is_dir():
        say(f"published in {target.root}")
    if archive is not None:
        count = write_archive(target, spec.name, archive)
        say(f"packed: {count} files in {archive}")
        if archive.is_dir():
            say(f"  to a hub: hf upload USER/NAME {archive} .   (what it says is in its README.md)")
