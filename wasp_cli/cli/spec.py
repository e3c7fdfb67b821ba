"""`wasp check` and `wasp schema`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wasp_cli.cli import completion as complete
from wasp_cli.cli.options import JsonOption, SetOption, argument, expected_errors, print_json

if TYPE_CHECKING:
    from wasp_cli.spec.places import Problem

PANEL = "Specs and tasks"

spec_app = typer.Typer()


@spec_app.command(
    rich_help_panel=PANEL,
    epilog="[bold]wasp check specs/*.yaml[/]   ·   [bold]wasp check specs/table1.yaml --json | jq '.[].problems'[/]\n\n"
    "Exit codes: 0 all are valid, 2 usage, 3 at least one is invalid.",
)
@expected_errors
def check(
    specs: Annotated[list[Path], argument(metavar="SPEC...", help="YAML files.", autocompletion=complete.specs)],
    set_: SetOption = None,
    json: JsonOption = False,
) -> None:
    """Validate specs and paper files: every mistake at once, with file, line and column."""
    from wasp_cli.console import say
    from wasp_cli.errors import SpecError
    from wasp_cli.spec.places import InvalidSpec

    found: list[dict[str, Any]] = []
    refused: dict[Problem, None] = {}  # two specs may extend the same wrong one
    for path in specs:
        try:
            cells, what = _what_it_has(path, set_ or ())
        except InvalidSpec as error:
            refused |= dict.fromkeys(error.problems)
            problems = [problem.as_json() for problem in error.problems]
            found.append({"file": str(path), "ok": False, "cells": None, "problems": problems})
            continue
        found.append({"file": str(path), "ok": True, "cells": cells, "problems": []})
        if not json:
            say(f"{path}: ok, {what}")
    if json:
        print_json(found)
    if refused and json:
        raise typer.Exit(SpecError.exit_code)  # all is said
    if refused:
        raise SpecError("\n".join(map(str, refused)))


def _what_it_has(path: Path, settings: Sequence[str]) -> tuple[int | None, str]:
    """Count the cells of a valid spec (None for a paper, which `--set` does not change), and say it in words."""
    from wasp_cli.plan.grid import cells_of
    from wasp_cli.spec.load import load
    from wasp_cli.spec.paper import is_paper, paper_of
    from wasp_cli.spec.read import read

    source = read(path)
    if is_paper(source):
        paper = paper_of(source)
        rows = sum(len(table.rows[task]) for table in paper.tables for task in table.rows)
        return None, f"{rows} printed rows, {len(paper.claims)} claims"
    spec = load(path, settings).spec
    cells = len(list(cells_of(spec)))
    return cells, f"{cells} cell{'s' if cells != 1 else ''}" if spec.methods else "training only"


@spec_app.command(
    rich_help_panel=PANEL, epilog="[bold]wasp schema > specs/wasp.schema.json[/]   ·   [bold]wasp schema --plugins > mine.schema.json[/]"
)
@expected_errors
def schema(
    plugins: Annotated[bool, typer.Option("--plugins", help="Include the names of installed plugins.")] = False,
) -> None:
    """Print the JSON Schema of specs, for completion and checks in an editor.

    The first line of a spec names it: `# yaml-language-server: $schema=wasp.schema.json`.
    """
    from wasp_cli.spec.schema import spec_schema

    print_json(spec_schema(plugins=plugins))
