"""Names for readers: of tasks, operator variants, assistants and their ablations."""

from __future__ import annotations

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.report.stats.frame import Group
from wasp_cli.tasks.registry import TASKS

ABLATIONS = {
    "full": "full",
    "safety-only": "safety gate only",
    "task-only": "task gate only",
    "no-case2": "no Case II recovery",
    "no-rollout": "no rollouts (H = 1)",
}
"""A variant of a plugin is printed as it is."""


def task_title(task: str) -> str:
    """Return the name of a task in tables."""
    return TASKS[task].title


def operator_title(variant: str) -> str:
    """Return the name of an operator variant in tables."""
    return "Unimpaired" if variant == UNIMPAIRED else OPERATORS[variant].title


def assistant_title(group: Group, ablation: bool = False) -> str:
    """Return the label of a row; an incomplete one says of how many cells it is the mean."""
    title = who_title(group.method, group.assistant_variant) if ablation else METHODS[group.method].title
    if not group.complete:
        title += f" [{len(group.cells)} of {len(group.cells) + group.absent} cells]"
    return title


def who_title(method: str, variant: str) -> str:
    """Return the name of a method with one of its ablations."""
    return f"{METHODS[method].title}, {ABLATIONS.get(variant, variant)}"
