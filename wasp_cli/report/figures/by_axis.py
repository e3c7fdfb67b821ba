"""Figures over the conditions of a grid: what each method does under each operator and severity, and how long it takes to decide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.report.figures.style import PALETTE, STYLES, drawn, figure_files
from wasp_cli.report.stats.frame import CellNumbers, Frame, Group, groups
from wasp_cli.report.stats.summary import summarise
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.report.tables.table import Column
from wasp_cli.report.tables.titles import operator_title, task_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Condition = tuple[str, float | None]
"""Operator variant and severity value."""
MEASURES = tuple(column for column in PAPER_COLUMNS if column.key in ("int_rate", "cost", "return"))


def severity_figure(frame: Frame, folder: Path) -> list[Path]:
    """Write `severity.png` and `.svg`: intervention rate, cost and return under every operator and severity; a row for each task.

    Returns:
        The written files; none where fewer than two conditions have been computed.
    """
    found = [group for group in groups(frame) if group.assistant_variant == "full" and METHODS[group.method].impaired and group.cells]
    conditions = _conditions(frame)
    tasks = list(dict.fromkeys(group.task for group in found))
    if not tasks or len(conditions) < 2:
        return []
    with drawn((max(7.5, 2.2 + 0.9 * len(conditions)), 0.6 + 2.9 * len(tasks))) as figure:
        panels = figure.subplots(len(tasks), len(MEASURES), squeeze=False, sharex=True)
        for row, task in zip(panels, tasks, strict=True):
            for panel, column in zip(row, MEASURES, strict=True):
                own = [group for group in found if group.task == task]
                for i, group in enumerate(own):
                    _over_conditions(panel, group, conditions, column, 0.5 * (i / max(len(own) - 1, 1) - 0.5))
                panel.set_title(f"{task_title(task)}: {column.heading}", loc="left", fontsize=9)
                _name_conditions(panel, list(conditions))
        handles = {label: handle for panel in panels.flat for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(7, len(handles)), frameon=False)
        return figure_files(figure, folder, "severity")


def _conditions(frame: Frame) -> dict[Condition, str]:
    """Every operator with each of its severities, as the spec lists them, with the name of the severity."""
    found: dict[Condition, str] = {}
    for cell in frame.cells:
        if cell.identity.variant != UNIMPAIRED:
            found.setdefault((cell.identity.variant, cell.identity.value), cell.severity or "")
    variants = list(dict.fromkeys(variant for variant, _ in found))
    return dict(sorted(found.items(), key=lambda item: variants.index(item[0][0])))


def _over_conditions(panel: Axes, group: Group, conditions: dict[Condition, str], column: Column, shift: float) -> None:
    """One method: a line over the severities of each operator; methods stand beside each other, so that none hides another."""
    colour, marker = STYLES.get(group.method, (PALETTE[0], "o"))
    places = {condition: i for i, condition in enumerate(conditions)}
    x, y, sd = [], [], []
    for _, own in groupby(conditions, key=lambda condition: condition[0]):
        for condition in own:
            value = summarise(_under(group, condition), column.key)
            x.append(places[condition] + shift)
            y.append(math.nan if value.mean is None else value.mean)
            sd.append(value.sd or 0.0)
        # A gap between operators, so that one line serves for all: each further one takes as long to draw as this one.
        x, y, sd = [*x, math.nan], [*y, math.nan], [*sd, 0.0]
    panel.errorbar(
        x, y, yerr=sd if any(sd) else None, fmt=marker, linestyle="-", color=colour, markersize=4, linewidth=0.9, elinewidth=0.8,
        label=METHODS[group.method].title,
    )  # fmt: skip


def _under(group: Group, condition: Condition) -> Sequence[CellNumbers]:
    return [cell for cell in group.cells if (cell.identity.variant, cell.identity.value) == condition]


def _name_conditions(panel: Axes, conditions: Sequence[Condition]) -> None:
    names = [f"{operator_title(variant)} {value:g}" if value is not None else operator_title(variant) for variant, value in conditions]
    panel.set_xticks(range(len(names)), names, rotation=35, ha="right", fontsize=7)
    panel.grid(axis="y", color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.set_ylim(bottom=min(0.0, panel.get_ylim()[0]))
    for i, (left, right) in enumerate(pairwise(conditions)):
        if left[0] != right[0]:
            panel.axvline(i + 0.5, color="#bbbbbb", linewidth=0.6)
