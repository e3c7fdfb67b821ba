"""`wasp check`: every mistake in specs, papers and environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wasp_cli.cli.command import command
from wasp_cli.cli.completion import spec_names
from wasp_cli.cli.options import JsonOption, SetOption, print_json
from wasp_cli.cli.parameters import argument, option
from wasp_cli.console import say
from wasp_cli.errors import SpecError
from wasp_cli.spec.shipped import spec_path

if TYPE_CHECKING:
    from wasp_cli.spec.load import Loaded
    from wasp_cli.spec.read import Problem
    from wasp_cli.tasks.foreign.learnable import Findings


@command(
    "wasp check specs/*.yaml",
    "wasp check specs/table1.yaml --json | jq '.[].problems'",
    codes="0 all are valid, 2 usage, 3 at least one is invalid",
)
def check(
    specs: Annotated[list[Path], argument("SPEC...", "YAML files.", among=spec_names)],
    steps: Annotated[
        int,
        option("--steps", "Env steps of each simple driver in an environment of others.", min=1),
    ] = 1000,
    set_: SetOption = None,
    json: JsonOption = False,
) -> None:
    """Name every mistake in specs and paper files.

    All at once, with file, line and column. An environment of your own is tried too: whether its
    worlds follow their seeds, whether many of it can run side by side, and whether there is
    anything to learn in it. Nothing is trained.
    """
    from wasp_cli.spec.read import InvalidSpec

    results: list[dict[str, Any]] = []
    refused: dict[Problem, None] = {}  # two specs may extend the same wrong one
    for path in specs:
        try:
            found = _examined(path, set_ or (), steps)
        except InvalidSpec as error:
            refused |= dict.fromkeys(error.problems)
            problems = [problem.as_json() for problem in error.problems]
            results.append({"file": str(path), "ok": False, "cells": None, "problems": problems})
            continue
        entry = {"file": str(path), "ok": True, "cells": found.cells, "problems": []}
        if found.environments:
            environments = found.environments.items()
            entry["environments"] = {
                task: {"summary": each.summary, "notes": each.notes} for task, each in environments
            }
        results.append(entry)
        if not json:
            say(f"{path}: ok, {found.what}")
            for task, each in found.environments.items():
                say(f"  {task}: {each.summary}", *(f"    {note}" for note in each.notes))
    if json:
        print_json(results)
    if refused:
        if json:  # it has named them
            raise typer.Exit(SpecError.exit_code)
        raise SpecError("\n".join(map(str, refused)))


@dataclass(frozen=True)
class _Examined:
    """What a valid spec has."""

    cells: int | None  # None for a paper
    what: str  # in words
    environments: Mapping[str, Findings]  # by task, what was met in environments of others


def _examined(path: Path, settings: Sequence[str], steps: int) -> _Examined:
    """Read a spec or a paper, which `--set` does not change, and try its environments.

    Raises:
        InvalidSpec: it has mistakes, or nothing can be learned in one of its environments.
    """
    from wasp_cli.plan.grid import cells_of
    from wasp_cli.spec.load import chain_of, loaded, override
    from wasp_cli.spec.paper import is_paper, paper_of
    from wasp_cli.spec.read import read

    path = spec_path(path)
    source = read(path)
    if is_paper(source):
        paper = paper_of(source)
        rows = sum(len(table.rows[task]) for table in paper.tables for task in table.rows)
        return _Examined(None, f"{rows} printed rows, {len(paper.claims)} claims", {})
    overrides = [override(number, text) for number, text in enumerate(settings, start=1)]
    found = loaded(chain_of(source), overrides)
    cells = len(list(cells_of(found.spec)))
    what = "training only"
    if found.spec.methods:
        what = f"{cells} cell{'s' if cells != 1 else ''}"
    return _Examined(cells, what, _environments(found, steps))


def _environments(found: Loaded, steps: int) -> dict[str, Findings]:
    """Try every environment of others that a spec names, by task.

    Raises:
        InvalidSpec: one of them is refused, with its place in the spec.
    """
    from wasp_cli.errors import TaskError
    from wasp_cli.spec.read import InvalidSpec
    from wasp_cli.tasks.registry import TASKS, ForeignInfo

    findings: dict[str, Findings] = {}
    refused: list[Problem] = []
    for number, task in enumerate(found.spec.tasks):
        if not isinstance(TASKS[task], ForeignInfo):
            continue
        # Not above: it imports gymnasium, which specs of built-in tasks do without.
        from wasp_cli.tasks.foreign.learnable import findings_of

        try:
            findings[task] = findings_of(task, found.spec.repeat_of(task), steps)
        except TaskError as error:
            refused += found.problem(("tasks", number), error.message, error.hint).problems
            continue
        for message, hint in findings[task].problems:
            words = f"environment '{task}': {message}"
            refused += found.problem(("tasks", number), words, hint).problems
    if refused:
        raise InvalidSpec(refused)
    return findings
