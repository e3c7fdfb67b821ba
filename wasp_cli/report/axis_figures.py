"""Figures of metrics along an axis: the severities of the operators, or the values of a swept setting.

A panel shows one metric. A curve has a value at every place of the axis, with the spread over seeds; what is undefined is a gap.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.report.figures import PALETTE, drawn, figure_files, legend, ruled, style_of
from wasp_cli.report.stats import Frame, Group, groups
from wasp_cli.report.summary import UNDEFINED, Value, summarise
from wasp_cli.report.tables.by_axis import REFERENCE, Condition, Line, Swept, condition_title, lines, operator_lines
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.report.tables.table import Column, task_title, who_title
from wasp_cli.store.layout import slug

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Numbers = Callable[[Column], Sequence[Value]]  # [N] the value of a metric at every place of the axis

SEVERITY_MEASURES = tuple(column for column in PAPER_COLUMNS if column.key in ("int_rate", "cost", "return"))
SWEEP_MEASURES = tuple(column for column in PAPER_COLUMNS if column.key in ("return", "success", "cost", "mag"))
MOST = 6  # operators with a curve each; of more, the mean is drawn
DASHES = (0, (4, 3))  # of Human-only, in the colour of the operator
MARKERS = ("o", "s", "^", "v", "D", "P")
COLOURS = PALETTE[1:]  # one for each operator; black is the mean
CROWDED = {"markersize": 4, "linewidth": 0.9, "elinewidth": 0.8}  # look of curves that stand beside each other
CLEAR = {"markersize": 5, "markeredgecolor": "white", "markeredgewidth": 0.6, "linewidth": 1.5, "elinewidth": 0.8, "capsize": 2}


@dataclass(frozen=True)
class Curve:
    label: str
    colour: str
    marker: str
    x: Sequence[float]  # [N]
    numbers: Numbers
    reference: Numbers | None = None  # of Human-only, dashed; None where there are none
    gaps: int = 0  # places whose cells are missing


def severity_figure(frame: Frame, folder: Path) -> list[Path]:
    assistants = [group for group in groups(frame) if group.variant == "full" and METHODS[group.method].impaired and group.cells]
    under = dict.fromkeys((cell.identity.operator, cell.identity.value) for cell in frame.cells if cell.identity.operator != UNIMPAIRED)
    variants = list(dict.fromkeys(variant for variant, _ in under))
    conditions = sorted(under, key=lambda condition: variants.index(condition[0]))
    tasks = list(dict.fromkeys(group.task for group in assistants))
    if not tasks or len(conditions) < 2:
        return []
    with drawn((max(7.5, 2.2 + 0.9 * len(conditions)), 0.6 + 2.9 * len(tasks))) as figure:
        panels = figure.subplots(len(tasks), len(SEVERITY_MEASURES), squeeze=False, sharex=True)
        for row, task in zip(panels, tasks, strict=True):
            own = [group for group in assistants if group.task == task]
            # Methods stand beside each other, so that none hides another.
            shifts = [0.5 * (i / max(len(own) - 1, 1) - 0.5) for i in range(len(own))]
            curves = [_over_conditions(group, conditions, shift) for group, shift in zip(own, shifts, strict=True)]
            for panel, column in zip(row, SEVERITY_MEASURES, strict=True):
                for curve in curves:
                    draw_curve(panel, curve, column, CROWDED)
                panel.set_title(f"{task_title(task)}: {column.heading}", loc="left", fontsize=9)
                _name_conditions(panel, conditions)
        legend(figure, panels.flat, loc="outside lower center", most=7)
        return figure_files(figure, folder, "severity")


def sweep_figures(key: str, swept: Sequence[Swept], folder: Path) -> list[Path]:
    tasks = dict.fromkeys(line.group.task for line in lines(swept))
    figures = {task: figure for task in tasks if (figure := sweep_figure(key, swept, task)) is not None}
    return [path for task, figure in figures.items() for path in figure_files(figure, folder, f"sweep_{slug(task)}")]


def sweep_figure(key: str, swept: Sequence[Swept], task: str) -> Figure | None:
    assistants = sweep_curves(swept, task)
    curves = [curve for own in assistants.values() for curve in own]
    if all(curve.gaps == len(swept) for curve in curves):
        return None
    # A single assistant fills a page's width in two rows; several have a row each.
    shape = (2, 2) if len(assistants) == 1 else (len(assistants), len(SWEEP_MEASURES))
    with drawn((0.6 + 2.9 * shape[1] if shape[1] == 2 else 10.5, 0.9 + 2.4 * shape[0])) as figure:
        panels = figure.subplots(*shape, squeeze=False).reshape(len(assistants), len(SWEEP_MEASURES))
        for row, (title, own) in zip(panels, assistants.items(), strict=True):
            for panel, column in zip(row, SWEEP_MEASURES, strict=True):
                for curve in own:
                    draw_curve(panel, curve, column, CLEAR)
                _name_values(panel, column, key, swept)
            if len(assistants) > 1:
                row[0].set_ylabel(title, fontweight="bold")
        heading = task_title(task) if len(assistants) > 1 else f"{task_title(task)}, {next(iter(assistants))}"
        if missing := sum(curve.gaps for curve in curves):
            heading += f" (cells are missing: {missing} point{'s' if missing > 1 else ''} left out)"
        figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
        dashed = {METHODS[REFERENCE].title: {"linestyle": DASHES, "color": "#555555"}} if any(curve.reference for curve in curves) else {}
        legend(figure, [panels[0][0]], loc="outside lower center", further=dashed, most=4)
        return figure


def draw_curve(panel: Axes, curve: Curve, column: Column, look: dict[str, Any]) -> None:
    order = sorted(range(len(curve.x)), key=lambda place: curve.x[place])
    x = [curve.x[place] for place in order]

    def printed(numbers: Numbers) -> tuple[list[float], list[float]]:
        values = numbers(column)
        means, spreads = ([getattr(values[place], name) for place in order] for name in ("mean", "sd"))
        scaled = ([math.nan if number is None else number * column.scale for number in found] for found in (means, spreads))
        return next(scaled), next(scaled)

    if curve.reference is not None:
        # Its entry in the legend would be one for each operator; the underscore keeps it out.
        mean, _ = printed(curve.reference)
        panel.plot(x, mean, linestyle=DASHES, color=curve.colour, linewidth=1.1, alpha=0.8, label=f"_{curve.label}")
    mean, spread = printed(curve.numbers)
    bars = spread if any(number > 0 for number in spread) else None
    panel.errorbar(x, mean, yerr=bars, fmt=curve.marker, linestyle="-", color=curve.colour, label=curve.label, **look)


def _over_conditions(group: Group, conditions: Sequence[Condition], shift: float) -> Curve:
    places: list[tuple[float, Condition | None]] = []
    for _, own in groupby(enumerate(conditions), key=lambda each: each[1][0]):
        places += [(place + shift, condition) for place, condition in own]
        # A gap between operators, so that one line serves for all: each further one takes as long to draw as this one.
        places.append((places[-1][0], None))

    def numbers(column: Column) -> list[Value]:
        under = [[cell for cell in group.cells if (cell.identity.operator, cell.identity.value) == condition] for _, condition in places]
        return [summarise(cells, column.key) for cells in under]

    title = who_title(group.method, group.variant)
    return Curve(title, *style_of(group.method), [x for x, _ in places], numbers)


def _name_conditions(panel: Axes, conditions: Sequence[Condition]) -> None:
    panel.set_xticks(range(len(conditions)), list(map(condition_title, conditions)), rotation=35, ha="right", fontsize=7)
    ruled(panel, "y")
    panel.set_ylim(bottom=min(0.0, panel.get_ylim()[0]))
    for i, (left, right) in enumerate(pairwise(conditions)):
        if left[0] != right[0]:
            panel.axvline(i + 0.5, color="#bbbbbb", linewidth=0.6)


def sweep_curves(swept: Sequence[Swept], task: str) -> dict[str, list[Curve]]:
    """Return by assistant a curve for each operator variant and severity, or one for all of them where they are many."""
    of_task = [line for line in lines(swept) if line.group.task == task and METHODS[line.group.method].impaired]
    by_operator = operator_lines(swept, of_task)
    conditions = list(dict.fromkeys(line.condition for line in by_operator))
    shown: list[Condition | None] = list(conditions) if len(conditions) <= MOST else [None]
    every = by_operator if len(conditions) <= MOST else of_task
    touched = dict.fromkeys(line.group.assistant[1:] for line in of_task if line.swept is not None)
    x, _ = positions([each.value for each in swept])
    by_assistant: dict[str, list[Curve]] = {}
    for assistant in [each for each in touched if each[0] != REFERENCE] or list(touched):
        for index, condition in enumerate(shown):
            own = _over_values(every, swept, assistant, condition)
            alone = _over_values(every, swept, (REFERENCE, "full"), condition) if assistant[0] != REFERENCE else []
            label = f"mean of {len(conditions)} operators" if condition is None else condition_title(condition)
            colour = PALETTE[0] if condition is None else COLOURS[index % len(COLOURS)]
            reference = _numbers(alone) if any(alone) else None
            curve = Curve(label, colour, MARKERS[index % len(MARKERS)], x, _numbers(own), reference, own.count(None))
            title = METHODS[assistant[0]].title if assistant[1] == "full" else who_title(*assistant)
            by_assistant.setdefault(title, []).append(curve)
    return by_assistant


def positions(values: Sequence[Any]) -> tuple[list[float], bool]:
    """Return where values stand on the x axis, and whether that is to scale: numbers are, anything else is one category after another."""
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return [float(value) for value in values], True
    return [float(index) for index in range(len(values))], False


def _over_values(
    every: Sequence[Line], swept: Sequence[Swept], assistant: tuple[str, str], condition: Condition | None
) -> list[Line | None]:
    own = [line for line in every if line.group.assistant[1:] == assistant and line.condition == condition]
    # A mean that leaves cells out would pass for another one.
    whole = [line for line in own if line.group.complete and line.group.cells]
    return [next((line for line in whole if line.swept in (None, each)), None) for each in swept]


def _numbers(rows: Sequence[Line | None]) -> Numbers:
    return lambda column: [UNDEFINED if line is None else line.values((column,))[0] for line in rows]


def _name_values(panel: Axes, column: Column, key: str, swept: Sequence[Swept]) -> None:
    panel.set_title(column.heading + (", mean deviation" if column.key == "mag" else ""), loc="left")
    panel.set_xlabel(key)
    places, scale = positions([each.value for each in swept])
    gaps = [b - a for a, b in pairwise(sorted(places))]
    if not scale or min(gaps) >= 0.08 * sum(gaps):  # closer ones would print over each other
        texts = [each.text if len(each.text) <= 12 else each.text[:11] + "…" for each in swept]
        panel.set_xticks(places, texts, parse_math=False)
    if column.key == "success":
        panel.set_ylim(-4, 104)
    elif column.key in ("cost", "mag"):
        panel.set_ylim(bottom=-0.03 * panel.get_ylim()[1])  # Human-only deviates by 0, and must show above the frame
    ruled(panel)
