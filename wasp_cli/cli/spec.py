"""`wasp check`, `init`, `schema`, `list` and `draw`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from wasp_cli.cli.command import command
from wasp_cli.cli.completion import spec_names, task_names
from wasp_cli.cli.options import JsonOption, SetOption, print_json
from wasp_cli.cli.parameters import argument, option, parse_folder
from wasp_cli.console import out, say
from wasp_cli.errors import SpecError, UsageError
from wasp_cli.registry import module_of
from wasp_cli.spec.shipped import SUFFIX, copy_specs, spec_path

if TYPE_CHECKING:
    from rich.text import Text

    from wasp_cli.operators.registry import OperatorInfo
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
        raise typer.Exit(SpecError.exit_code) if json else SpecError("\n".join(map(str, refused)))


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


@command("wasp init", "wasp init experiments/specs")
def init(
    folder: Annotated[Path, argument("DIR", "Where to.", parser=parse_folder)] = Path("specs"),
) -> None:
    """Copy the specs that come with wasp, to edit them.

    Files that are there stay as they are.
    """
    written, kept = copy_specs(folder)
    say(
        *(f"{path}: written" for path in written),
        *(f"{path}: is there, not changed" for path in kept),
    )


@command("wasp schema > specs/wasp.schema.json")
def schema() -> None:
    """Print the JSON Schema of specs, for editors.

    It is for completion and checks, with the names of installed plugins. The first line of a spec
    names it: `# yaml-language-server: $schema=wasp.schema.json`.
    """
    from wasp_cli.spec.schema import spec_schema

    print_json(spec_schema())


@command("wasp list", "wasp list methods", "wasp list tasks --json | jq '.[].gym_id'", name="list")
def list_names(
    what: Annotated[
        Literal["methods", "operators", "tasks"] | None,
        argument("methods|operators|tasks", "Which. (default: all three)"),
    ] = None,
    json: JsonOption = False,
) -> None:
    """List assistants, operators and tasks.

    What a spec can name, with what plugins bring: how an assistant decides and what it needs
    trained, what an operator's severity means, and a task's spaces, cost sources and limits.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    listed = {name: rows() for name, (rows, *_) in LISTS.items() if what in (None, name)}
    if json:
        print_json(listed if what is None else listed[what])
        return
    for name, rows in listed.items():
        _, headings, cells, further = LISTS[name]
        # Only the second column may break a line between words.
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        for number, heading in enumerate(headings):
            table.add_column(heading, no_wrap=number != 1)
        for row in rows:
            table.add_row(named(row), *map(Text, cells(row)))
            table.add_section()
        out().print(table)
        say(further)


Row = dict[str, Any]


def methods() -> list[Row]:
    from wasp_cli.methods.registry import METHODS

    return [
        {
            "name": info.name,
            "title": info.title,
            "rule": info.rule,
            "variants": list(info.variants),
            "needs": list(info.needs),
            "needs_with": list(dict.fromkeys(kind for *_, kind in info.needs_with)),
            "module": module_of(info.target),
        }
        for info in METHODS.values()
    ]


def operators() -> list[Row]:
    from wasp_cli.operators.registry import OPERATORS

    return [
        {
            "name": info.name,
            "title": info.title,
            "severity": info.unit,
            "low": info.low,
            "high": info.high,
            "auto": _tried(info),
            "module": module_of(info.target),
        }
        for info in OPERATORS.values()
    ]


def _tried(info: OperatorInfo) -> str | None:
    """What a severity that is `auto` tries, in words; None where none can be."""
    if not info.simulated:
        return None
    if info.between == "checkpoints":
        return "earlier checkpoints"
    numbers = ", ".join(f"{severity:g}" for severity in info.ladder())
    return f"{numbers} decisions" if info.between == "decisions" else numbers


def tasks() -> list[Row]:
    from wasp_cli.tasks.base import CAMERA_SIZE
    from wasp_cli.tasks.make import make_task
    from wasp_cli.tasks.registry import TASKS

    # without a camera, which would take most of the time
    made = {name: make_task(name, 1, observe=()) for name in TASKS}
    return [
        {
            "name": name,
            "title": TASKS[name].title,
            "gym_id": TASKS[name].gym_id,
            "env_steps": TASKS[name].env_steps,
            "seconds": round(TASKS[name].env_steps * TASKS[name].env_seconds, 6),
            "success_goals": TASKS[name].success_goals,
            "state_size": task.state_size,
            "pixels_shape": (6, CAMERA_SIZE, CAMERA_SIZE),
            "privileged_size": task.privileged_size,
            "action_low": tuple(task.action_low.tolist()),
            "action_high": tuple(task.action_high.tolist()),
            "cost_sources": task.cost_sources,
        }
        for name, task in made.items()
    ]


def method_cells(info: Row) -> tuple[str, ...]:
    stages = [*info["needs"], *(f"({kind})" for kind in info["needs_with"])]
    variants = [variant for variant in info["variants"] if variant != "full"]
    return info["rule"] or "see its documentation", "\n".join(stages), "\n".join(variants)


def operator_cells(info: Row) -> tuple[str, ...]:
    """Return the cells of an operator in `wasp list`: its severity, the range of it, and what
    `auto` tries.
    """
    return info["severity"], f"{info['low']:g} to {info['high']:g}", info["auto"] or ""


def task_cells(task: Row) -> tuple[str, ...]:
    pixels = "x".join(map(str, task["pixels_shape"]))
    sides = zip(task["action_low"], task["action_high"], strict=True)
    bounds = dict.fromkeys(
        f"±{high:g}" if low == -high else f"[{low:g}, {high:g}]" for low, high in sides
    )
    action = f"action {len(task['action_low'])} in {', '.join(bounds)}"
    spaces = (
        f"state {task['state_size']}\npixels {pixels}\nprivileged "
        f"{task['privileged_size']}\n{action}"
    )
    goals = f"{task['success_goals']} goal{'s' if task['success_goals'] > 1 else ''}"
    return (
        spaces,
        "\n".join(task["cost_sources"]) or "none",
        f"{task['env_steps']} steps\n{task['seconds']:g} s\n{goals}",
    )


LISTS: dict[
    str, tuple[Callable[[], list[Row]], tuple[str, ...], Callable[[Row], tuple[str, ...]], str]
] = {
    "methods": (
        methods,
        ("Method", "How it decides", "Stages", "Variants"),
        method_cells,
        "Stages are trained besides world model and policies; in brackets: under some "
        "settings only.",
    ),
    "operators": (
        operators,
        ("Operator", "Severity", "Range", "auto tries"),
        operator_cells,
        "Your own assistant or operator: docs/extending.md",
    ),
    "tasks": (
        tasks,
        ("Task", "Spaces", "Costs", "Limit"),
        task_cells,
        "Gymnasium ids with cost and images are tasks: docs/own_task.md",
    ),
}


def named(info: Row) -> Text:
    """Return a name; below it the title of a method or operator where that is another word, the
    id of a task, and a plugin's package.
    """
    from rich.text import Text

    name, text = info["name"], Text(info["name"], style="bold")
    if "gym_id" in info:
        return text.append(f"\n{info['gym_id']}", style="dim")
    title, package = info["title"], info["module"].partition(".")[0]
    if title.lower().replace(",", "").replace(" ", "-") != name:
        text.append(f"\n{title}", style="dim")
    return text if package == "wasp_cli" else text.append(f"\nfrom {package}", style="dim")


@command(
    "wasp draw goal1 --seed 3 --out map.png",
    "wasp draw my_pkg:MyEnv-v0",
    "wasp draw my_spec.yaml",
    codes="0 done, 1 the environment fails or the disk refuses, 2 usage, or no such folder",
)
def draw(
    task: Annotated[
        str,
        argument(
            "TASK",
            "A task (goal1), a gymnasium id (my_pkg:MyEnv-v0), or the file of a spec (its tasks).",
            among=task_names,
        ),
    ],
    seed: Annotated[int, option("N", "Seed of the layout.", min=0, max=2**32 - 1)] = 0,
    out: Annotated[
        Path | None,
        option("PNG", "File of the picture. (default: <task>_seed<N>.png)", "--out", "-o"),
    ] = None,
) -> None:
    """Draw a layout of a task: its map and camera images."""
    from wasp_cli.tasks.sheet import draw_sheet

    if Path(task).suffix != SUFFIX:
        say(str(draw_sheet(task, seed, out)))
        return
    from wasp_cli.spec.load import load

    spec = load(spec_path(Path(task))).spec
    if out is not None and len(spec.tasks) > 1:
        raise UsageError(
            f"'{task}' has {len(spec.tasks)} tasks, and --out names one picture", "leave --out away"
        )
    spec.declare_tasks()
    for name in spec.tasks:
        say(str(draw_sheet(name, seed, out)))
