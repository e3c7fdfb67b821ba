"""`wasp list`: tasks, methods and operators by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from wasp_cli.cli.command import command
from wasp_cli.cli.options import JsonOption, print_json
from wasp_cli.cli.parameters import argument
from wasp_cli.console import out, say
from wasp_cli.registry import module_of

if TYPE_CHECKING:
    from rich.text import Text

    from wasp_cli.operators.registry import OperatorInfo


Row = dict[str, Any]
"""An entry of `wasp list --json`."""


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

    rows = {name: each.rows() for name, each in LISTINGS.items() if what in (None, name)}
    if json:
        print_json(rows if what is None else rows[what])
        return
    for name, listed in rows.items():
        listing = LISTINGS[name]
        # Only the second column may break a line between words.
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        for number, heading in enumerate(listing.headings):
            table.add_column(heading, no_wrap=number != 1)
        for row in listed:
            table.add_row(named(row), *map(Text, listing.cells(row)))
            table.add_section()
        out().print(table)
        say(listing.foot)


def methods() -> list[Row]:
    """Return every assistant, with what it needs trained."""
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
    """Return every operator, with the meaning and the range of its severity."""
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
    """The values that `auto` tries for a severity, in words; None for people."""
    if not info.simulated:
        return None
    if info.between == "checkpoints":
        return "earlier checkpoints"
    numbers = ", ".join(f"{severity:g}" for severity in info.ladder())
    return f"{numbers} decisions" if info.between == "decisions" else numbers


def tasks() -> list[Row]:
    """Return every task, with its spaces, costs and limits."""
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
    """Return the cells of a method: how it decides, its stages and its variants."""
    stages = [*info["needs"], *(f"({kind})" for kind in info["needs_with"])]
    variants = [variant for variant in info["variants"] if variant != "full"]
    return info["rule"] or "see its documentation", "\n".join(stages), "\n".join(variants)


def operator_cells(info: Row) -> tuple[str, ...]:
    """Return the cells of an operator in `wasp list`: its severity, the range of it, and what
    `auto` tries.
    """
    return info["severity"], f"{info['low']:g} to {info['high']:g}", info["auto"] or ""


def task_cells(task: Row) -> tuple[str, ...]:
    """Return the cells of a task: its spaces, its costs and its limits."""
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


def named(info: Row) -> Text:
    """Return a name with more lines below it: the title of a method or operator if that is another
    word, the id of a task, and the package of a plugin.
    """
    from rich.text import Text

    name = info["name"]
    text = Text(name, style="bold")
    if "gym_id" in info:
        return text.append(f"\n{info['gym_id']}", style="dim")
    title = info["title"]
    package = info["module"].partition(".")[0]
    if title.lower().replace(",", "").replace(" ", "-") != name:
        text.append(f"\n{title}", style="dim")
    return text if package == "wasp_cli" else text.append(f"\nfrom {package}", style="dim")


@dataclass(frozen=True)
class Listing:
    """One of the tables of `wasp list`."""

    rows: Callable[[], list[Row]]
    headings: tuple[str, ...]
    cells: Callable[[Row], tuple[str, ...]]
    """The cells of a row behind its name."""
    foot: str
    """What is printed below."""


LISTINGS = {
    "methods": Listing(
        methods,
        ("Method", "How it decides", "Stages", "Variants"),
        method_cells,
        "Stages are trained besides world model and policies; in brackets: under some "
        "settings only.",
    ),
    "operators": Listing(
        operators,
        ("Operator", "Severity", "Range", "auto tries"),
        operator_cells,
        "Your own assistant or operator: docs/extending.md",
    ),
    "tasks": Listing(
        tasks,
        ("Task", "Spaces", "Costs", "Limit"),
        task_cells,
        "Gymnasium ids with cost and images are tasks: docs/own_task.md",
    ),
}
