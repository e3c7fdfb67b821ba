"""The table of `wasp tasks`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich import box
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from wasp_cli.tasks.describe import Description


def task_table(tasks: Sequence[Description]) -> Table:
    """Make a row per task."""
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
