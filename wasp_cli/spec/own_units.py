"""Settings with other defaults on a task of one's own. Most of them are `auto`: numbers that are
computed from the task.

A cost per 1000 env steps, or a number of costly decisions, that fits the tasks of this package may
not fit another one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from wasp_cli.tasks.registry import TASKS

AUTO = "auto"
FIELDS: Mapping[tuple[str, str], str] = {
    ("expert", "cost_limit"): AUTO,
    ("policies", "cost_allowance"): AUTO,
    ("residual", "cost_limit"): AUTO,
    ("wasp", "tau_c"): AUTO,
    ("wasp", "patience"): "horizon",
    ("ida-guarded", "tau_c"): AUTO,
}
"""By section and field, the value on a task of one's own."""
STAGES = ("expert", "policies", "residual")
"""Sections of stages, which any method may need; the others are those of methods."""
Changes = Mapping[str, Mapping[str, Mapping[str, Any]]]


def with_auto(
    tasks: Iterable[str], methods: Iterable[str], by_task: Changes, document: Mapping[str, Any]
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the settings that tasks have of their own (by task, section and field), with those of
    FIELDS added where a document does not set them for a task of one's own.
    """
    used = {*STAGES, *methods}
    changed = {
        task: {name: dict(fields) for name, fields in sections.items()}
        for task, sections in by_task.items()
    }
    for task in tasks:
        if task in TASKS.own:
            continue
        for (section, field), value in FIELDS.items():
            here = by_task.get(task, {}).get(section, {})
            everywhere = document.get(section)
            written = field in here or (isinstance(everywhere, Mapping) and field in everywhere)
            if section in used and not written:
                changed.setdefault(task, {}).setdefault(section, {})[field] = value
    return changed
