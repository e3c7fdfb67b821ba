"""Names for readers: of tasks, operator variants, assistants and their ablations."""

from __future__ import annotations

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.report.stats.frame import Group
from wasp_cli.tasks.registry import TASKS


def task_title(task: str) -> str:
    """Return the name of a task in tables."""
    return TASKS[task].title


def operator_title(variant: str) -> str:
    """Return the name of an operator variant in tables."""
    return "Unimpaired" if variant == UNIMPAIRED else OPERATORS[variant].title


def assistant_title(group: Group, ablation: bool = False) -> str:
    """Return the label of a row; an incomplete one says of how many cells it is the mean."""
    info = METHODS[group.method]
    title = info.title
    if ablation:
        title += f", {variant_title(group.method, group.variant)}"
    if not group.complete:
        title += f" [{len(group.cells)} of {len(group.cells) + group.absent} cells]"
    return title


def who_title(method: str, variant: str) -> str:
    """Return the title of a method, with that of its ablation unless it is the whole method.

    What no registry knows, of a plugin that is gone or of another version, keeps its name.
    """
    title = METHODS[method].title if method in METHODS else method
    return title if variant == "full" else f"{title}, {variant_title(method, variant)}"


def is_row(group: Group) -> bool:
    """Return whether a row stands in every table: a method as a whole, and no ablation."""
    return group.variant == "full"


def variant_title(method: str, variant: str) -> str:
    """Return the title of an ablation; of an unknown one its name."""
    return METHODS[method].variants.get(variant, variant) if method in METHODS else variant
