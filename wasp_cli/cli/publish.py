"""`wasp publish`: results that go into git."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli.options import ResultsOption, SelectOption, SetOption, SpecArgument, TaskOption, expected_errors, folder_of

publish_app = typer.Typer()


@publish_app.command(
    epilog="[bold]wasp publish specs/quickstart.yaml --dry-run[/]   ·   "
    "[bold]wasp publish specs/table1.yaml --select 'task=goal1' --select 'stage=world_model'[/]\n\n"
    "Exit codes: 0 done, 1 something is not computed, damaged or names this machine, 2 usage, 3 invalid spec."
)
@expected_errors
def publish(
    spec: SpecArgument,
    results: ResultsOption = Path("results"),
    to: Annotated[
        Path | None,
        typer.Option("--to", metavar="DIR", parser=folder_of, help="Where to. (default: published/ in the results)", show_default=False),
    ] = None,
    task: TaskOption = None,
    select: SelectOption = None,
    largest: Annotated[float, typer.Option("--largest", min=0, metavar="MB", help="Leave out what is larger.")] = 8.0,
    reuse: Annotated[
        str,
        typer.Option("--reuse", metavar="none|published|DIR", help="none: what this code computed; otherwise as for wasp run."),
    ] = "none",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be published.")] = False,
    set_: SetOption = None,
) -> None:
    """Copy results of a spec, with its report, to where git keeps them.

    A later run takes them from there instead of training (--reuse published). What is published already stays as it is.
    """
    from wasp_cli.console import out, waiting_aloud
    from wasp_cli.run.publish import carry_publication, publication
    from wasp_cli.run.record import results_of
    from wasp_cli.run.session import restricted
    from wasp_cli.run.show import show_publication
    from wasp_cli.spec.load import load
    from wasp_cli.store.layout import Layout
    from wasp_cli.store.lock import held

    loaded = restricted(load(spec, set_ or ()), task)
    layout = results_of(results.absolute())
    target = Layout(layout.published if to is None else to.absolute())
    # Meanwhile nothing is removed.
    with held(layout.planning, waiting_aloud("waiting for wasp gc"), shared=True):
        found = publication(loaded.spec, layout, target, select or (), largest * 1e6, reuse)
        show_publication(found, largest * 1e6, out())
        if dry_run:
            return
        carry_publication(found, loaded.spec, layout, target)
    out().print(f"published in {target.root}", markup=False, soft_wrap=True)
