"""How much a method intervenes, and what that leaves, against the severity of the operator's impairment: table `severity`."""

from __future__ import annotations

from dataclasses import replace

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.report.stats.frame import CellNumbers, Frame
from wasp_cli.report.stats.summary import spread_note
from wasp_cli.report.tables.main import LABELS, PAPER_COLUMNS, full_groups, labels_of, missing_notes, part_of
from wasp_cli.report.tables.table import Column, Row, Table
from wasp_cli.report.tables.titles import assistant_title, operator_title, task_title

MEASURES = tuple(column for key in ("int_rate", "cost", "return") for column in PAPER_COLUMNS if column.key == key)


def operator_table(frame: Frame) -> Table:
    """Return and cost per operator variant, over its severities."""
    wanted = [group for group in full_groups(frame) if METHODS[group.method].impaired]
    variants = dict.fromkeys(cell.identity.variant for group in wanted for cell in group.cells if cell.identity.variant != UNIMPAIRED)
    columns = [(variant, column) for variant in variants for column in PAPER_COLUMNS if column.key in ("return", "cost")]
    rows = []
    for group in wanted:
        numbers = [part_of(group, group.of_variant(variant), column) for variant, column in columns]
        rows.append(Row(labels_of(group), tuple(numbers)))
    headings = [
        Column(f"{variant}.{column.key}", f"{operator_title(variant)}: {column.title}", column.better, column.digits)
        for variant, column in columns
    ]
    return Table(
        "operators", "Per operator variant", LABELS, tuple(headings), tuple(rows), meanings=("Mean over the severities of a variant.",)
    )


def severity_table(frame: Frame) -> Table | None:
    """Per task, operator variant and method: intervention rate, cost and return at every severity; None where no variant has two."""
    wanted = [group for group in full_groups(frame) if METHODS[group.method].impaired]
    cells = [cell for group in wanted for cell in group.cells if cell.identity.variant != UNIMPAIRED]
    levels = list(dict.fromkeys(level(cell) for cell in cells))
    of_variant: dict[str, set[str]] = {}
    for cell in cells:
        of_variant.setdefault(cell.identity.variant, set()).add(level(cell))
    if all(len(found) < 2 for found in of_variant.values()):
        return None
    rows = []
    for task in dict.fromkeys(group.task for group in wanted):
        for variant in of_variant:
            for group in (group for group in wanted if group.task == task):
                own = {name: [cell for cell in group.of_variant(variant) if level(cell) == name] for name in levels}
                numbers = (part_of(group, own[name], measure) for measure in MEASURES for name in levels)
                rows.append(Row((task_title(task), operator_title(variant), assistant_title(group)), tuple(numbers)))
    columns = tuple(
        replace(measure, key=f"{measure.key}.{name}", title=f"{measure.title} {name}") for measure in MEASURES for name in levels
    )
    notes = (spread_note(cells), *missing_notes(frame))
    meanings = ("An assistant that helps where it is needed intervenes more when the operator gets worse.",)
    return Table("severity", "Against severity", ("Task", "Operator", "Method"), columns, tuple(rows), notes, meanings, grouping=2)


def level(cell: CellNumbers) -> str:
    """The severity as the spec names it, otherwise its value."""
    return cell.severity or f"{cell.identity.value:g}"
