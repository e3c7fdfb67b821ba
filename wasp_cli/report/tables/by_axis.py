"""Tables along an axis: per operator, per severity, and per value of a swept setting."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.report.stats import CellNumbers, Frame, Group, Missing, groups, row_of
from wasp_cli.report.summary import Value, paired_difference, spread_note
from wasp_cli.report.tables import main
from wasp_cli.report.tables.main import full_groups, labels_of, missing_notes, part_of, values
from wasp_cli.report.tables.table import Column, Row, Table, assistant_title, operator_title, task_title
from wasp_cli.store.tables import CellIdentity

SEVERITY_MEASURES = tuple(column for key in ("int_rate", "cost", "return") for column in main.PAPER_COLUMNS if column.key == key)
REFERENCE = "human"
SWEEP_COLUMNS = (*main.PAPER_COLUMNS, *(column for column in main.MORE_COLUMNS if column.key == "mag_int"))
SWEEP_OPERATOR_COLUMNS = tuple(column for column in main.PAPER_COLUMNS if column.key in ("return", "success", "cost"))
UNTOUCHED = "-"  # the value of a method whose cells are the same for every value
UNTOUCHED_NOTE = f"{UNTOUCHED} in place of a value: the setting does not touch this method, whose cells are the same for every value."
DIFFERENCE = "In brackets: mean difference to Human-only over the operators, severities and seeds that both have."
CHOICE = "The best of several values looks better than it is: choose on seeds that no table uses, and report on others."

Condition = tuple[str, float | None]  # operator variant and severity value


def operator_table(frame: Frame) -> Table:
    impaired = [group for group in full_groups(frame) if METHODS[group.method].impaired]
    variants = dict.fromkeys(cell.identity.operator for group in impaired for cell in group.cells if cell.identity.operator != UNIMPAIRED)
    columns = [(variant, column) for variant in variants for column in main.PAPER_COLUMNS if column.key in ("return", "cost")]
    rows = []
    for group in impaired:
        numbers = [part_of(group, group.of_variant(variant), column) for variant, column in columns]
        rows.append(Row(labels_of(group), tuple(numbers)))
    headings = [
        Column(f"{variant}.{column.key}", f"{operator_title(variant)}: {column.title}", column.better, column.digits)
        for variant, column in columns
    ]
    return Table(
        "operators", "Per operator variant", main.LABELS, tuple(headings), tuple(rows), meanings=("Mean over the severities of a variant.",)
    )


def severity_table(frame: Frame) -> Table | None:
    impaired = [group for group in full_groups(frame) if METHODS[group.method].impaired]
    cells = [cell for group in impaired for cell in group.cells if cell.identity.operator != UNIMPAIRED]
    levels = list(dict.fromkeys(level(cell) for cell in cells))
    of_variant: dict[str, set[str]] = {}
    for cell in cells:
        of_variant.setdefault(cell.identity.operator, set()).add(level(cell))
    if all(len(severities) < 2 for severities in of_variant.values()):
        return None
    rows = []
    for task in dict.fromkeys(group.task for group in impaired):
        for variant in of_variant:
            for group in (group for group in impaired if group.task == task):
                own = {name: [cell for cell in group.of_variant(variant) if level(cell) == name] for name in levels}
                numbers = (part_of(group, own[name], measure) for measure in SEVERITY_MEASURES for name in levels)
                rows.append(Row((task_title(task), operator_title(variant), assistant_title(group)), tuple(numbers)))
    columns = tuple(
        replace(measure, key=f"{measure.key}.{name}", title=f"{measure.title} {name}") for measure in SEVERITY_MEASURES for name in levels
    )
    notes = (spread_note(cells), *missing_notes(frame))
    meanings = ("An assistant that helps where it is needed intervenes more when the operator gets worse.",)
    return Table("severity", "Against severity", ("Task", "Operator", "Method"), columns, tuple(rows), notes, meanings, grouping=2)


def level(cell: CellNumbers) -> str:
    return cell.severity or f"{cell.identity.value:g}"


@dataclass(frozen=True, eq=False)
class Swept:
    """The cells under one value of the setting."""

    text: str  # the value as it was written
    value: Any  # the same as a file would have it
    frame: Frame
    keys: Mapping[CellIdentity, str]  # the key of each wanted cell; two values share a cell when its key is the same


@dataclass(frozen=True, eq=False)
class Line:
    """What a row stands for: the cells of an assistant, or those under one operator, under one value."""

    group: Group
    swept: Swept | None  # None where the setting does not touch the assistant
    reference: tuple[CellNumbers, ...]  # the cells of Human-only under the same value; empty for itself, and where it does not run
    condition: Condition | None = None  # None for all operators

    @property
    def text(self) -> str:
        return UNTOUCHED if self.swept is None else self.swept.text

    def values(self, columns: Sequence[Column]) -> tuple[Value, ...]:
        """Return the numbers of the row. Human-only corrects nothing, so the columns of autonomy have no difference to it."""
        pairs = zip(values(self.group, columns), columns, strict=True)
        return tuple(
            value if column.key in main.AUTONOMY else replace(value, delta=paired_difference(self.group.cells, self.reference, column.key))
            for value, column in pairs
        )

    def as_json(self, columns: Sequence[Column]) -> dict[str, Any]:
        facts: dict[str, Any] = {
            "task": self.group.task, "method": self.group.method, "variant": self.group.variant,
            "touched": self.swept is not None, "value": None if self.swept is None else self.swept.value,
            "cells": len(self.group.cells), "missing": self.group.absent,
        }  # fmt: skip
        if self.condition is not None:
            facts |= {"operator": self.condition[0], "severity": self.condition[1]}
        numbers = zip(columns, self.values(columns), strict=True)
        return facts | {c.key: {"mean": v.mean, "sd": v.sd, "difference": v.delta, "seeds": v.n} for c, v in numbers}


def lines(swept: Sequence[Swept]) -> list[Line]:
    """List a line for each assistant and value, in the order of the spec; one for an assistant that the setting does not touch."""
    by_value = [{group.assistant: group for group in groups(each.frame)} for each in swept]
    result = []
    for assistant in dict.fromkeys(assistant for by_assistant in by_value for assistant in by_assistant):
        keys = [frozenset(key for identity, key in each.keys.items() if row_of(identity) == assistant) for each in swept]
        same = len(set(keys)) == 1
        for each, by_assistant in list(zip(swept, by_value, strict=True))[: 1 if same else None]:
            if assistant in by_assistant:
                alone = by_assistant.get((assistant[0], REFERENCE, "full"))
                reference = alone.cells if alone is not None and assistant[1] != REFERENCE else ()
                result.append(Line(by_assistant[assistant], None if same else each, reference))
    # Values of one setting may miss cells, but a task stays together.
    tasks = list(dict.fromkeys(line.group.task for line in result))
    return sorted(result, key=lambda line: tasks.index(line.group.task))


def operator_lines(swept: Sequence[Swept], of: Iterable[Line]) -> list[Line]:
    """List the lines of impaired assistants once more for each operator variant and severity, Human-only and all values of one together."""
    of = [line for line in of if METHODS[line.group.method].impaired]
    result = []
    for task in dict.fromkeys(line.group.task for line in of):
        identities = (identity for each in swept for identity in each.frame.order if identity.task == task)
        conditions = dict.fromkeys(_condition(identity) for identity in identities if METHODS[identity.method].impaired)
        result += [_under(line, swept, condition) for condition in conditions for line in of if line.group.task == task]
    return result


def sweep_table(key: str, swept: Sequence[Swept]) -> Table:
    rows_of = lines(swept)
    rows = [Row((*labels_of(line.group), line.text), line.values(SWEEP_COLUMNS)) for line in rows_of]
    frame = combined(key, swept)
    notes = (spread_note(frame.cells), *missing_notes(frame), CHOICE)
    meanings = (
        *main.MEANINGS[:1],
        *[DIFFERENCE] * any(line.reference for line in rows_of),
        *[UNTOUCHED_NOTE] * any(line.swept is None for line in rows_of),
    )
    return Table("sweep", f"Values of {key}", ("Task", "Method", key), SWEEP_COLUMNS, tuple(rows), notes, meanings)


def sweep_operator_table(key: str, swept: Sequence[Swept]) -> Table:
    rows = []
    for line in operator_lines(swept, lines(swept)):
        assert line.condition is not None
        labels = (task_title(line.group.task), condition_title(line.condition), assistant_title(line.group), line.text)
        rows.append(Row(labels, line.values(SWEEP_OPERATOR_COLUMNS)))
    labels = ("Task", "Operator", "Method", key)
    return Table("sweep_operators", f"Values of {key}, per operator", labels, SWEEP_OPERATOR_COLUMNS, tuple(rows), grouping=2)


def combined(key: str, swept: Sequence[Swept]) -> Frame:
    """Join the cells of all values, each once; a missing cell is named with the value that it belongs to."""
    cells: dict[str, CellNumbers] = {}
    missing: dict[str, Missing] = {}
    order: dict[str, CellIdentity] = {}
    for each in swept:
        order |= {each.keys[identity]: identity for identity in each.frame.order}
        cells |= {each.keys[cell.identity]: cell for cell in each.frame.cells}
        for gap in each.frame.missing:
            shared = all(other.keys.get(gap.identity) == each.keys[gap.identity] for other in swept)
            missing[each.keys[gap.identity]] = gap if shared else replace(gap, label=f"{gap.label} [{key}={each.text}]")
    return Frame(tuple(cells.values()), tuple(missing.values()), tuple(order.values()))


def condition_title(condition: Condition) -> str:
    variant, value = condition
    return operator_title(variant) if value is None else f"{operator_title(variant)} {value:g}"


def _condition(identity: CellIdentity) -> Condition:
    return identity.operator, identity.value


def _under(line: Line, swept: Sequence[Swept], condition: Condition) -> Line:
    frame = (line.swept or swept[0]).frame
    absent = [gap.identity for gap in frame.missing if _condition(gap.identity) == condition]
    own = sum((gap.task, gap.method, gap.variant) == line.group.assistant for gap in absent)
    cells = tuple(cell for cell in line.group.cells if _condition(cell.identity) == condition)
    return replace(line, group=replace(line.group, cells=cells, absent=own), condition=condition)
