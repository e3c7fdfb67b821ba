"""Numbers that follow from a task of one's own (`auto`), where its spec does not write them.

A cost per 1000 env steps, or a number of costly decisions, that fits the tasks of this package says
nothing of another one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from wasp_cli.tasks.registry import TASKS

AUTO = "auto"
FIELDS = (
    ("expert", "cost_limit"),
    ("policies", "cost_allowance"),
    ("residual", "cost_limit"),
    ("wasp", "tau_c"),
    ("ida-guarded", "tau_c"),
)
"""Section and field of each such number."""
STAGES = ("expert", "policies", "residual")
"""Sections of stages, which any method may need; the others are those of methods."""
Changes = Mapping[str, Mapping[str, Mapping[str, Any]]]


def with_auto(
    tasks: Iterable[str], methods: Iterable[str], by_task: Changes, document: Mapping[str, Any]
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the settings that tasks have of their own, by task, section and field, with `auto`
    where a document leaves a number open that follows from a task of one's own.
    """
    used = {*STAGES, *methods}
    changed = {
        task: {name: dict(fields) for name, fields in sections.items()}
        for task, sections in by_task.items()
    }
    for task in tasks:
        if task in TASKS.own:
            continue
        for section, field in FIELDS:
            here = by_task.get(task, {}).get(section, {})
            everywhere = document.get(section)
            written = field in here or (isinstance(everywhere, Mapping) and field in everywhere)
            if section in used and not written:
                changed.setdefault(task, {}).setdefault(section, {})[field] = AUTO
    return changed
