"""The main table in a sentence for each task."""

from __future__ import annotations

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.stats import Frame
from wasp_cli.report.stats.summary import summarise
from wasp_cli.report.tables import full_groups, task_title


def in_words(frame: Frame) -> list[str]:
    """Say of each task what WASP makes of the operators, and which assistant returns most; nothing where either is missing or partial."""
    lines = []
    for task in dict.fromkeys(group.task for group in full_groups(frame)):
        whole = {group.method: group.cells for group in full_groups(frame) if group.task == task and group.complete}
        if not {"human", "wasp"} <= whole.keys():
            continue
        returns, costs, acts = (
            {m: summarise(cells, key).mean or 0.0 for m, cells in whole.items()} for key in ("return", "cost", "int_rate")
        )
        line = (
            f"{task_title(task)}: the operators alone return {returns['human']:.1f} at a cost of {costs['human']:.1f}, "
            f"with WASP {returns['wasp']:.1f} at {costs['wasp']:.1f}; it changes {acts['wasp']:.0%} of the commands."
        )
        others = [m for m in whole if METHODS[m].impaired and METHODS[m].attended and m not in ("human", "wasp")]
        if others:
            best = max(others, key=returns.__getitem__)
            line += f" Of the others {METHODS[best].title} returns most: {returns[best]:.1f} at {costs[best]:.1f}."
        lines.append(line)
    return lines
