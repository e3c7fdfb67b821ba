"""A plan as people read it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wasp_cli.console import duration
from wasp_cli.plan.plan import Plan

if TYPE_CHECKING:
    from rich.console import Console


def show(plan: Plan, console: Console, workers: int) -> None:
    """Print the counts by kind, the size of the grid, and what stands in the way."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 2), header_style="bold")
    table.add_column("stage")
    for column in ("nodes", "cached", "to run", "failed before"):
        table.add_column(column, justify="right")
    for kind in plan.kinds():
        counts = [
            sum(step.node.kind == kind for step in plan.steps),
            plan.count("cached", kind),
            plan.count("missing", kind) + plan.count("damaged", kind),
        ]
        counts.append(plan.count("failed", kind))
        table.add_row(kind, *(str(count) if count else "-" for count in counts))
    table.add_section()
    fresh = plan.count("missing") + plan.count("damaged")
    totals = [len(plan.steps), plan.count("cached"), fresh, plan.count("failed")]
    table.add_row("total", *map(str, totals), style="bold")
    console.print(table)
    cells = len({node.key for _, node in plan.grid.cells})
    text = f"{plan.grid.points} grid points, {cells} cells to evaluate"
    if cells < plan.grid.points:
        text += " (the unimpaired reference is one cell for all operators)"
    console.print(text if cells else "nothing to evaluate: the spec lists no methods")
    for step in plan.steps:
        if step.state in ("failed", "damaged"):
            console.print(f"{step.node.label}: {step.reason}", markup=False, soft_wrap=True)
    console.print(_time(plan, workers))


def _time(plan: Plan, workers: int) -> str:
    if not plan.to_run():
        return "nothing to run"
    seconds, unknown = plan.estimate(workers)
    who = f"{workers} worker" + ("s" if workers > 1 else "")
    if not seconds:
        return "no node of these sizes has been measured yet, so there is no estimate of the time"
    rest = f", without {unknown} nodes of sizes that have not been measured yet" if unknown else ""
    return f"about {duration(seconds)} on {who}{rest}"
