"""A plan as `wasp plan` prints it: counts by kind, reasons, and how long it takes."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, get_args

from wasp_cli.console import count_table, duration
from wasp_cli.operators.registry import PERSON, UNIMPAIRED
from wasp_cli.plan.plan import Plan, State

if TYPE_CHECKING:
    from rich.console import Console


COLUMNS: dict[State, str] = {state: state for state in get_args(State)} | {
    "failed": "failed before",
    "unneeded": "not needed",
}
SHOWN = 12


def show(
    plan: Plan, console: Console, workers: int, *, cores: int | None = None, every: bool = False
) -> None:
    """Print the counts by kind, why nodes have to run, the size of the grid, and how long a run
    takes.

    Args:
        workers: processes of the run.
        cores: that they share; None: one for each.
        every: whether each node is listed, with its state and reason.
    """
    counts = plan.counts()
    total = sum(counts.values(), Counter())
    columns = [state for state in COLUMNS if state in ("cached", "missing") or total[state]]
    table = count_table("stage", "nodes", *(COLUMNS[state] for state in columns))
    for kind, states in counts.items():
        table.add_row(kind, str(states.total()), *(str(states[state] or "-") for state in columns))
    table.add_section()
    table.add_row(
        "total", str(total.total()), *(str(total[state]) for state in columns), style="bold"
    )
    console.print(table)
    cells, branched = (
        len({node.key for _, node in pairs}) for pairs in (plan.grid.cells, plan.grid.branched)
    )
    size = f"{plan.grid.points} grid points, {cells} cells to evaluate"
    if cells < plan.grid.points and any(cell.operator == UNIMPAIRED for cell, _ in plan.grid.cells):
        size += " (the unimpaired reference is one cell for all operators)"
    if branched:
        size += f"; the interventions of {branched} of them are judged by counterfactual branches"
    console.print(size if cells else "nothing to evaluate: the spec lists no methods")
    for line in (
        *plan.grid.notes,
        *(_every(plan) if every else _reasons(plan)),
        *_chosen(plan),
        *_time(plan, workers, cores or workers),
    ):
        console.print(line, markup=False, soft_wrap=True)


def _chosen(plan: Plan) -> list[str]:
    """A line for each operating point and each severity that is known."""
    labels = {step.node.key: step.node.label for step in plan.steps}
    return [f"{labels[key]}: {choice}" for key, choice in plan.chosen.items()]


def _reasons(plan: Plan) -> list[str]:
    lines = reason_lines(plan, "published", "changed", "failed", "damaged")
    if len(lines) > SHOWN:
        lines[SHOWN:] = [f"and {len(lines) - SHOWN} more reasons; --all lists every node"]
    if any(
        step.state == "published" and plan.grid.reused[step.node.key].details for step in plan.steps
    ):
        lines.append("wasp plan --all names what has changed since then")
    return lines


def reason_lines(plan: Plan, *states: State) -> list[str]:
    """Return a line for each reason of nodes in some states: the first node, and how many others
    have it.
    """
    labels: dict[str, list[str]] = {}
    for step in plan.steps:
        if step.state in states:
            labels.setdefault(step.reason, []).append(step.node.label)
    return [
        f"{first}{f' and {len(more)} more' if more else ''}: {reason}"
        for reason, (first, *more) in labels.items()
    ]


def _every(plan: Plan) -> list[str]:
    labels = max((len(step.node.label) for step in plan.steps), default=0)
    lines = [
        f"{step.node.key[:8]}  {COLUMNS[step.state]:<13}  {step.node.label:<{labels}}  "
        f"{step.reason}"
        for step in plan.steps
    ]
    details = [
        reused.details if (reused := plan.grid.reused.get(step.node.key)) else ""
        for step in plan.steps
    ]
    return [f"{line}; {more}" if more else line for line, more in zip(lines, details, strict=True)]


def _time(plan: Plan, workers: int, cores: int) -> list[str]:
    """How long a run takes, and what the estimate is based on."""
    # Runs that compute nothing, and cells that people drive.
    if not plan.to_run():
        copied = plan.count("published")
        if not copied:
            return ["nothing to run"]
        results = "result" if copied == 1 else "results"
        return [f"nothing to compute: a run copies {copied} published {results}"]
    people = [node for node in plan.to_run() if node.axes.get("operator") == PERSON]
    lines: list[str] = []
    if people:
        lines = [
            f"{len(people)} cell{'s wait' if len(people) > 1 else ' waits'} for people, "
            "whom no run replaces: wasp drive SPEC"
        ]
        if len(people) == len(plan.to_run()):
            return lines
    seconds, unknown = plan.estimate(workers, cores)
    if not seconds:
        return [
            *lines,
            "no time estimate: neither here nor elsewhere was a node like these measured",
        ]

    # What the time does not count, and where it comes from.
    remarks = ""
    if unknown:
        remarks += f", not counting {unknown} nodes of sizes that have not been measured"
    if plan.begun:
        cells = "1 cell" if len(plan.begun) == 1 else f"{len(plan.begun)} cells"
        remarks += f"; whole batches of episodes of {cells} are there and are taken over"
    alike = sum(node.sort in plan.guessed for node in plan.to_run())
    if alike:
        remarks += (
            f"; for {alike} nodes an estimate, from times of nodes like them or of another machine"
        )
    borrowed = sum(node.sort in plan.borrowed for node in plan.to_run())
    if borrowed:
        remarks += f"; for {borrowed} nodes an estimate, from other tasks and sizes"

    # The longest chain of nodes, whose middle is left out if it is long.
    longest, path = plan.critical_path(cores)
    names = [node.label for node in path]
    if len(names) > SHOWN:
        names[SHOWN // 2 : -SHOWN // 2] = ["..."]
    return [
        *lines,
        f"about {duration(seconds)} on {workers} worker{'s' if workers > 1 else ''}{remarks}",
        *_unmeasured(plan),
        f"critical path {duration(longest)}: {' > '.join(names)}",
    ]


def _unmeasured(plan: Plan) -> list[str]:
    """What the time does not count, by environment."""
    decisions: Counter[str] = Counter()
    for node in plan.to_run():
        decisions[node.task] += plan.unmeasured.get(node.sort, 0)
    return [
        f"not counting about {count:,} decisions in {task}: how long one takes there is known when "
        "the first node of a run has ended"
        for task, count in decisions.items()
        if count
    ]
