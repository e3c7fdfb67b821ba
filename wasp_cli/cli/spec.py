"""`wasp check`, `init`, `schema`, `methods`, `tasks` and `tasks show`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wasp_cli.cli import completion as complete
from wasp_cli.cli.options import JsonOption, SetOption, argument, expected_errors, flag, option, parse_folder, print_json
from wasp_cli.registry import module_of

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from wasp_cli.spec.places import Problem
    from wasp_cli.tasks.describe import Description

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

    results: list[dict[str, Any]] = []
    refused: dict[Problem, None] = {}  # two specs may extend the same wrong one
    for path in specs:
        try:
            cells, what = _what_it_has(path, set_ or ())
        except InvalidSpec as error:
            refused |= dict.fromkeys(error.problems)
            problems = [problem.as_json() for problem in error.problems]
            results.append({"file": str(path), "ok": False, "cells": None, "problems": problems})
            continue
        results.append({"file": str(path), "ok": True, "cells": cells, "problems": []})
        if not json:
            say(f"{path}: ok, {what}")
    if json:
        print_json(results)
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
    from wasp_cli.spec.shipped import spec_path

    path = spec_path(path)
    source = read(path)
    if is_paper(source):
        paper = paper_of(source)
        rows = sum(len(table.rows[task]) for table in paper.tables for task in table.rows)
        return None, f"{rows} printed rows, {len(paper.claims)} claims"
    spec = load(path, settings).spec
    cells = len(list(cells_of(spec)))
    return cells, f"{cells} cell{'s' if cells != 1 else ''}" if spec.methods else "training only"


@spec_app.command(rich_help_panel=PANEL, epilog="[bold]wasp init[/]   ·   [bold]wasp init experiments/specs[/]")
@expected_errors
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", parser=parse_folder, help="Where to.")] = Path("specs"),
) -> None:
    """Copy the specs that come with wasp to a folder, to edit them. Files that are there stay as they are."""
    from wasp_cli.console import say
    from wasp_cli.spec.shipped import copy_specs

    written, kept = copy_specs(folder)
    say(*(f"{path}: written" for path in written), *(f"{path}: is there, not changed" for path in kept))


@spec_app.command(
    rich_help_panel=PANEL, epilog="[bold]wasp schema > specs/wasp.schema.json[/]   ·   [bold]wasp schema --plugins > mine.schema.json[/]"
)
@expected_errors
def schema(
    plugins: Annotated[bool, flag("--plugins", help="Include the names of installed plugins.")] = False,
) -> None:
    """Print the JSON Schema of specs, for completion and checks in an editor.

    The first line of a spec names it: `# yaml-language-server: $schema=wasp.schema.json`.
    """
    from wasp_cli.spec.schema import spec_schema

    print_json(spec_schema(plugins=plugins))


tasks_app = typer.Typer(
    invoke_without_command=True,
    help="List the tasks, or show one.",
    epilog="[bold]wasp tasks[/]   ·   [bold]wasp tasks show goal1 --seed 3[/]   ·   [bold]wasp tasks --json | jq '.[].gym_id'[/]",
)


@tasks_app.callback()
@expected_errors
def tasks(context: typer.Context, json: JsonOption = False) -> None:
    """List the tasks with their spaces, cost sources and limits, or show one (wasp tasks show)."""
    if context.invoked_subcommand is not None:
        if json:
            from wasp_cli.errors import UsageError

            raise UsageError("--json is for the list of tasks; a task is shown as a picture", "wasp tasks --json")
        return
    from dataclasses import asdict

    from wasp_cli.console import out, say
    from wasp_cli.tasks.describe import describe

    descriptions = describe()
    if json:
        print_json([asdict(task) for task in descriptions])
        return
    out().print(task_table(descriptions))
    say("Any gymnasium id is a task too: docs/own_task.md")


@spec_app.command(
    rich_help_panel="Specs and tasks", epilog="[bold]wasp methods[/]   ·   [bold]wasp methods --json | jq '.operators[].name'[/]"
)
@expected_errors
def methods(json: JsonOption = False) -> None:
    """List the assistants and the simulated operators that a spec can name, with those of plugins."""
    from wasp_cli.console import out, say
    from wasp_cli.methods.registry import METHODS
    from wasp_cli.operators.registry import OPERATORS

    assistants = [
        {
            "name": info.name, "title": info.title, "rule": info.rule, "variants": list(info.variants),
            "needs": list(info.needs), "needs_with": list(dict.fromkeys(kind for *_, kind in info.needs_with)),
            "module": module_of(info.target),
        }
        for info in METHODS.values()
    ]  # fmt: skip
    operators = [
        {
            "name": info.name,
            "title": info.title,
            "severity": info.unit,
            "low": info.low,
            "high": info.high,
            "module": module_of(info.target),
        }
        for info in OPERATORS.values()
    ]  # fmt: skip
    if json:
        print_json({"methods": assistants, "operators": operators})
        return
    out().print(method_table(assistants))
    say("Stages are trained besides the world model and the policies; those in brackets under some settings only.")
    out().print(operator_table(operators))
    say("Your own assistant or operator: docs/extending.md")


def method_table(methods: Sequence[Mapping[str, Any]]) -> Table:
    """Make a row per assistant: its name, how it decides, the stages that it needs of its own, and its variants."""
    table = listing("Method", "How it decides", "Stages", "Variants")
    for info in methods:
        shown = [each for each in info["variants"] if each != "full"]
        stages = [*info["needs"], *(f"({kind})" for kind in info["needs_with"])]
        table.add_row(named(info), info["rule"] or "see its documentation", "\n".join(stages), "\n".join(shown))
        table.add_section()
    return table


def operator_table(operators: Sequence[Mapping[str, Any]]) -> Table:
    """Make a row per operator variant: its name, what its severity means, and from where to where."""
    table = listing("Operator", "Severity", "Range")
    for info in operators:
        table.add_row(named(info), info["severity"], f"{info['low']:g} to {info['high']:g}")
    return table


def named(info: Mapping[str, Any]) -> Text:
    """Return the name, below it the title in tables where that is another word, and for what a plugin brings its package."""
    from rich.text import Text

    name, title, package = str(info["name"]), str(info["title"]), str(info["module"]).partition(".")[0]
    text = Text(name, style="bold")
    if title.lower().replace(",", "").replace(" ", "-") != name:
        text.append(f"\n{title}", style="dim")
    return text if package == "wasp_cli" else text.append(f"\nfrom {package}", style="dim")


def listing(*headings: str) -> Table:
    """Make an empty table; only its first column keeps its words together."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for number, heading in enumerate(headings):
        table.add_column(heading, no_wrap=number != 1)
    return table


def task_table(tasks: Sequence[Description]) -> Table:
    """Make a row per task."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("Task", "Spaces", "Costs", "Limit"):
        table.add_column(heading, no_wrap=True)
    for task in tasks:
        cells = [Text(cell) for cell in (_spaces(task), _costs(task), _limit(task))]
        table.add_row(Text(task.name, style="bold").append(f"\n{task.gym_id}", style="dim"), *cells)
        table.add_section()
    return table


def _spaces(task: Description) -> str:
    shape = "x".join(map(str, task.pixels_shape))
    return f"state {task.state_size}\npixels {shape}\nprivileged {task.privileged_size}\n{_actions(task)}"


def _actions(task: Description) -> str:
    pairs = zip(task.action_low, task.action_high, strict=True)
    bounds = dict.fromkeys(f"±{high:g}" if low == -high else f"[{low:g}, {high:g}]" for low, high in pairs)
    return f"action {len(task.action_low)} in " + ", ".join(bounds)


def _costs(task: Description) -> str:
    return "\n".join(task.cost_sources) or "none"


def _limit(task: Description) -> str:
    goals = f"{task.success_goals} goal{'s' if task.success_goals > 1 else ''}"
    return f"{task.env_steps} steps\n{task.seconds:g} s\n{goals}"


@tasks_app.command(
    "show",
    epilog="[bold]wasp tasks show goal1 --seed 3 --out map.png[/]   ·   [bold]wasp tasks show my_pkg:MyEnv-v0[/]\n\n"
    "Exit codes: 0 done, 1 the environment fails or the file cannot be written, 2 usage.",
)
@expected_errors
def show_task(
    task: Annotated[str, argument(metavar="ID", help="A task (goal1) or a gymnasium id (my_pkg:MyEnv-v0).", autocompletion=complete.tasks)],
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**32 - 1, metavar="N", help="Seed of the layout.")] = 0,
    out: Annotated[Path | None, option("--out", metavar="PNG", help="File of the picture. (default: <task>_seed<N>.png)")] = None,
    steps: Annotated[
        int, typer.Option("--steps", min=0, metavar="N", help="Also show the first N decision steps, up to the end of the episode.")
    ] = 0,
) -> None:
    """Draw a layout: the map from above and both camera images."""
    from wasp_cli.console import say
    from wasp_cli.tasks.sheet import draw_sheet

    path = draw_sheet(task, seed, steps, out)
    say(str(path))
