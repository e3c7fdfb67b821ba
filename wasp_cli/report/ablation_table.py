"""The paper's Table 2: variants of an assistant beside the full one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.frame import Frame, Group, groups
from wasp_cli.report.main_table import PAPER_COLUMNS, missing_notes, values
from wasp_cli.report.statistics import paired_difference, spread_note
from wasp_cli.report.table import Row, Table
from wasp_cli.report.titles import assistant_title, task_title


def ablation_table(frame: Frame) -> Table | None:
    """Per task and variant the values and, in brackets, the paired difference to the full method; None without ablations."""
    found = groups(frame)
    ablated = {group.method for group in found if group.assistant_variant != "full"}
    found = sorted((group for group in found if group.method in ablated), key=_order(found))
    if not found:
        return None
    full = {(group.task, group.method): group.cells for group in found if group.assistant_variant == "full"}
    rows = []
    for group in found:
        numbers = values(group, PAPER_COLUMNS)
        reference = full.get((group.task, group.method), ())
        if group.assistant_variant != "full":
            pairs = zip(numbers, PAPER_COLUMNS, strict=True)
            numbers = tuple(replace(value, delta=paired_difference(group.cells, reference, column.key)) for value, column in pairs)
        rows.append(Row((task_title(group.task), assistant_title(group, ablation=True)), numbers))
    cells = [cell for group in found for cell in group.cells]
    meanings = ("In brackets: mean difference to the full method over the operators, severities and seeds that both have.",)
    return Table(
        "table2", "Ablations", ("Task", "Variant"), PAPER_COLUMNS, tuple(rows), (spread_note(cells), *missing_notes(frame)), meanings
    )


def _order(found: list[Group]) -> Callable[[Group], tuple[int, str, int, str]]:
    """Sort key: tasks as they come, variants as the registry lists them."""
    tasks = list(dict.fromkeys(group.task for group in found))

    def key(group: Group) -> tuple[int, str, int, str]:
        known = list(METHODS[group.method].variants)
        place = known.index(group.assistant_variant) if group.assistant_variant in known else len(known)
        return tasks.index(group.task), group.method, place, group.assistant_variant

    return key
