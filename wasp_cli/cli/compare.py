"""`wasp compare`: two results folders cell by cell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wasp_cli.cli.options import expected_errors, folder_of, print_json

if TYPE_CHECKING:
    from wasp_cli.compare.runs import Compared, Side

compare_app = typer.Typer()


@compare_app.command(
    epilog="[bold]wasp compare results/ ../before/results[/]   ·   "
    "[bold]wasp compare results/ results/ --spec-a table1 --spec-b mine[/]\n\n"
    "Exit codes: 0 compared, 1 with --strict: they are not alike, 2 a folder or a spec is not there."
)
@expected_errors
def compare(
    first: Annotated[Path, typer.Argument(metavar="A", parser=folder_of, help="A results folder.", show_default=False)],
    second: Annotated[Path, typer.Argument(metavar="B", parser=folder_of, help="Another one.", show_default=False)],
    spec: Annotated[
        str | None,
        typer.Option("--spec", metavar="NAME", help="Only the spec of this name. (default: all that ran in both)", show_default=False),
    ] = None,
    spec_a: Annotated[
        str | None, typer.Option("--spec-a", metavar="NAME", help="This spec of A, with --spec-b of B.", show_default=False)
    ] = None,
    spec_b: Annotated[
        str | None, typer.Option("--spec-b", metavar="NAME", help="This spec of B, whatever its name.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", parser=folder_of, help="Also write it as Markdown, CSV, LaTeX and HTML.", show_default=False),
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="End with 1 where a cell differs by more than noise, or is not there.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Every cell with its numbers, for machines.")] = False,
) -> None:
    """Compare two results folders cell by cell: what changed, and whether it is more than noise.

    The last run of each spec counts. From the stored rows alone; nothing is executed.
    """
    from wasp_cli.compare.runs import compare as compared_runs
    from wasp_cli.compare.text import as_json, show, write
    from wasp_cli.console import out as console
    from wasp_cli.errors import NotAccepted, UsageError

    if out is not None and out.exists() and not out.is_dir():
        raise UsageError(f"'{out}' is no folder", "--out names a folder, which is made where there is none")
    found: list[Compared] = [compared_runs(*pair) for pair in _pairs(first, second, spec, spec_a, spec_b)]
    paths = [] if out is None else write(found, out)
    if json:
        print_json([as_json(each) for each in found])
    else:
        for each in found:
            show(each, console())
        if paths:
            console().print(f"written: {paths[0]} (its tables are beside it)", markup=False, soft_wrap=True)
    unlike = [each.first.spec.name for each in found if not each.alike]
    if strict and unlike:
        raise NotAccepted(f"not alike: {', '.join(unlike)}", "the cells that differ by more than noise, or are not there, are named above")


def _pairs(first: Path, second: Path, spec: str | None, spec_a: str | None, spec_b: str | None) -> list[tuple[Side, Side]]:
    """The runs that are compared: two named specs, or every spec that has run in both folders.

    Raises:
        UsageError: a folder holds no results that can be read, or no such spec; or nothing has run in both.
    """
    from wasp_cli.compare.runs import Side
    from wasp_cli.errors import ArtifactError, StoreError, UnknownName, UsageError
    from wasp_cli.report.provenance import last_runs
    from wasp_cli.run.record import read_run, results_of

    if (spec_a is None) != (spec_b is None) or (spec is not None and spec_a is not None):
        what = "--spec-a and --spec-b belong together, and stand in the place of --spec"
        raise UsageError(what, "wasp compare A B --spec-a mine --spec-b other")
    spec_a, spec_b = (spec, spec) if spec is not None else (spec_a, spec_b)
    try:
        layouts = [results_of(folder) for folder in (first, second)]
        runs = [last_runs(layout)[0] for layout in layouts]
        for name, known, folder in ((spec_a, runs[0], first), (spec_b, runs[1], second)):
            if name is not None and name not in known:
                raise UnknownName("spec", name, known, f"no spec '{name}' has run in '{folder}'")
        names = [(spec_a, spec_b)] if spec_a is not None and spec_b is not None else [(name, name) for name in runs[0] if name in runs[1]]
        if not names:
            which = "; ".join(f"'{folder}' has {', '.join(known) or 'none'}" for folder, known in zip((first, second), runs, strict=True))
            raise UsageError(f"no spec has run in both folders: {which}", "--spec-a and --spec-b name two specs")
        found = []
        for pair in names:
            sides = [(layout, read_run(layout, known[name])) for layout, known, name in zip(layouts, runs, pair, strict=True)]
            a, b = (Side(layout, run.run_id, run.spec, run.cells) for layout, run in sides)
            found.append((a, b))
    except (StoreError, ArtifactError) as error:
        raise UsageError(error.message, error.hint) from error
    return found
