"""`wasp compare`: two results folders, cell by cell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.options import print_json
from wasp_cli.cli.parameters import argument, directory, flag, option, parse_folder
from wasp_cli.console import out as console
from wasp_cli.console import say
from wasp_cli.errors import (
    NotAccepted,
    UsageError,
)

if TYPE_CHECKING:
    from wasp_cli.compare import Compared


@command(
    "wasp compare results/ ../before/results",
    "wasp compare results/ results/ --spec-a table1 --spec-b mine",
    codes="0 compared, 1 with --strict: they differ, 2 a folder or a spec does not exist",
)
def compare(
    first: Annotated[Path, argument("A", "A results folder.", parser=parse_folder)],
    second: Annotated[Path, argument("B", "Another results folder.", parser=parse_folder)],
    spec: Annotated[
        str | None, option("NAME", "Only the spec of this name. (default: all that ran in both)")
    ] = None,
    spec_a: Annotated[str | None, option("NAME", "The spec in A; needs --spec-b.")] = None,
    spec_b: Annotated[str | None, option("NAME", "The spec in B; needs --spec-a.")] = None,
    out: Annotated[
        Path | None,
        directory(
            "Also write the comparison there, as Markdown, CSV, LaTeX and HTML.", "--out", "-o"
        ),
    ] = None,
    strict: Annotated[
        bool,
        flag(
            "--strict", "Exit with 1 if a cell differs by more than noise, or is missing in A or B."
        ),
    ] = False,
    json: options.JsonOption = False,
) -> None:
    """Compare two results folders, cell by cell.

    What changed, and is it more than noise? The last run of each spec counts. Only stored rows are
    read; nothing is computed.
    """
    from wasp_cli.compare import compare as compared_runs
    from wasp_cli.compare import pairs
    from wasp_cli.compare.text import as_json, show, write

    if out is not None and out.exists() and not out.is_dir():
        raise UsageError(
            f"'{out}' is not a folder", "--out names a folder; it is created if it does not exist"
        )
    comparisons: list[Compared] = [
        compared_runs(*pair) for pair in pairs(first, second, spec, spec_a, spec_b)
    ]
    paths = [] if out is None else write(comparisons, out)
    if json:
        print_json([as_json(compared) for compared in comparisons])
    else:
        for compared in comparisons:
            show(compared, console())
        if paths:
            say(f"written: {paths[0]} (its tables are in the same folder)")
    unlike = [compared.first.spec.name for compared in comparisons if not compared.alike]
    if strict and unlike:
        raise NotAccepted(
            f"not alike: {', '.join(unlike)}",
            "the comparison names what is missing, not installed here or beyond noise",
        )
