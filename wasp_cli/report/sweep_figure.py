"""The curves of a sweep: what each value of a setting does to return, success, cost and the deviation from the command."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.figure import LOOK, PALETTE, save
from wasp_cli.report.main_table import PAPER_COLUMNS
from wasp_cli.report.sweep_table import REFERENCE, Condition, Line, Swept, condition_title, lines, operator_lines
from wasp_cli.report.table import UNDEFINED, Column
from wasp_cli.report.titles import task_title, who_title
from wasp_cli.store.layout import slug

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANELS = tuple(column for column in PAPER_COLUMNS if column.key in ("return", "success", "cost", "mag"))
MOST = 6
"""Operators with a curve each; of more, the mean is drawn."""
DASHES = (0, (4, 3))
"""Of Human-only, in the colour of the operator."""
MARKERS = ("o", "s", "^", "v", "D", "P")
COLOURS = PALETTE[1:]
"""One for each operator; black is the mean."""


@dataclass(frozen=True)
class Curve:
    """One assistant under one operator (or under all), over the values of the setting."""

    label: str
    colour: str
    marker: str
    lines: tuple[Line | None, ...]
    """The cells under each value; None where there are none."""
    alone: tuple[Line | None, ...]
    """Those of Human-only."""


def sweep_figures(key: str, swept: Sequence[Swept], folder: Path) -> list[Path]:
    """Write `sweep_<task>.png` and `.svg` for every task.

    Args:
        key: the setting.
        swept: the cells under each of its values.
        folder: where the files go.

    Returns:
        The written files; none of a task without any computed cell.
    """
    from matplotlib import rc_context

    files = []
    for task in dict.fromkeys(line.group.task for line in lines(swept)):
        with rc_context(LOOK):
            figure = sweep_figure(key, swept, task)
            if figure is not None:
                files += save(figure, [folder / f"sweep_{slug(task)}.{ending}" for ending in ("png", "svg")])
    return files


def sweep_figure(key: str, swept: Sequence[Swept], task: str) -> Figure | None:
    """The curves of one task: four panels for each assistant that the setting touches. None where nothing has been computed."""
    # Imported here: matplotlib takes most of a second, and most commands draw nothing.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    assistants = curves(swept, task)
    if not any(line for found in assistants.values() for curve in found for line in curve.lines):
        return None
    # A single assistant fills a page's width in two rows; several have a row each.
    shape = (2, 2) if len(assistants) == 1 else (len(assistants), len(PANELS))
    figure = Figure(figsize=(0.6 + 2.9 * shape[1] if shape[1] == 2 else 10.5, 0.9 + 2.4 * shape[0]), layout="constrained", dpi=160)
    FigureCanvasAgg(figure)
    panels = figure.subplots(*shape, squeeze=False).reshape(len(assistants), len(PANELS))
    places, scale = positions([each.value for each in swept])
    for row, (title, found) in zip(panels, assistants.items(), strict=True):
        for panel, column in zip(row, PANELS, strict=True):
            for curve in found:
                _draw(panel, curve, column, places)
            _dress(panel, column, key, [each.text for each in swept], places, scale)
        if len(assistants) > 1:
            row[0].set_ylabel(title, fontweight="bold")
    heading = task_title(task) if len(assistants) > 1 else f"{task_title(task)}, {next(iter(assistants))}"
    figure.suptitle(heading + _gaps(assistants), x=0.01, ha="left", fontweight="bold")
    handles, labels = panels[0][0].get_legend_handles_labels()
    if any(line for found in assistants.values() for curve in found for line in curve.alone):
        handles.append(Line2D([], [], linestyle=DASHES, color="#555555"))
        labels.append(METHODS[REFERENCE].title)
    figure.legend(handles, labels, loc="outside lower center", ncols=math.ceil(len(labels) / math.ceil(len(labels) / 4)), frameon=False)
    return figure


def curves(swept: Sequence[Swept], task: str) -> dict[str, list[Curve]]:
    """By assistant: a curve for each operator variant and severity, or one for all of them where they are many."""
    of_task = [line for line in lines(swept) if line.group.task == task and METHODS[line.group.method].impaired]
    by_operator = operator_lines(swept, of_task)
    conditions = list(dict.fromkeys(line.condition for line in by_operator))
    drawn: list[Condition | None] = list(conditions) if len(conditions) <= MOST else [None]
    every = by_operator if len(conditions) <= MOST else of_task
    touched = dict.fromkeys(_assistant(line) for line in of_task if line.swept is not None)
    wanted = [assistant for assistant in touched if assistant[0] != REFERENCE] or list(touched)
    found: dict[str, list[Curve]] = {}
    for assistant in wanted:
        for index, condition in enumerate(drawn):
            label = f"mean of {len(conditions)} operators" if condition is None else condition_title(condition)
            colour = PALETTE[0] if condition is None else COLOURS[index % len(COLOURS)]
            own = _over_values(every, swept, assistant, condition)
            alone = _over_values(every, swept, (REFERENCE, "full"), condition) if assistant[0] != REFERENCE else (None,) * len(swept)
            found.setdefault(_title(assistant), []).append(Curve(label, colour, MARKERS[index % len(MARKERS)], own, alone))
    return found


def positions(values: Sequence[Any]) -> tuple[list[float], bool]:
    """Where values stand on the x axis, and whether that is to scale: numbers are, anything else is one category after the other."""
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return [float(value) for value in values], True
    return [float(index) for index in range(len(values))], False


def _over_values(
    every: Sequence[Line], swept: Sequence[Swept], assistant: tuple[str, str], condition: Condition | None
) -> tuple[Line | None, ...]:
    """The line of an assistant under each value; an untouched one has the same under all."""
    own = [line for line in every if _assistant(line) == assistant and line.condition == condition]
    # A mean that leaves cells out would pass for another one.
    return tuple(
        next((line for line in own if line.swept in (None, each) and line.group.complete and line.group.cells), None) for each in swept
    )


def _draw(panel: Axes, curve: Curve, column: Column, places: Sequence[float]) -> None:
    order = sorted(range(len(places)), key=lambda index: places[index])
    x = [places[index] for index in order]
    if any(curve.alone):
        y, _ = _numbers([curve.alone[index] for index in order], column)
        # Its entry in the legend would be one for each operator; the underscore keeps it out.
        panel.plot(x, y, linestyle=DASHES, color=curve.colour, linewidth=1.1, alpha=0.8, label=f"_{curve.label}")
    y, spread = _numbers([curve.lines[index] for index in order], column)
    panel.errorbar(
        x, y, yerr=spread, marker=curve.marker, color=curve.colour, markersize=5, markeredgecolor="white", markeredgewidth=0.6,
        linewidth=1.5, elinewidth=0.8, capsize=2, label=curve.label,
    )  # fmt: skip


def _numbers(found: Sequence[Line | None], column: Column) -> tuple[list[float], list[float]]:
    """Mean and standard deviation over seeds, as printed; NaN where there is none."""
    values = [UNDEFINED if line is None else line.values((column,))[0] for line in found]

    def scaled(number: float | None) -> float:
        return math.nan if number is None else number * column.scale

    return [scaled(value.mean) for value in values], [scaled(value.sd) for value in values]


def _dress(panel: Axes, column: Column, key: str, texts: Sequence[str], places: Sequence[float], scale: bool) -> None:
    panel.set_title(column.heading + (", mean deviation" if column.key == "mag" else ""), loc="left")
    panel.set_xlabel(key)
    gaps = [b - a for a, b in zip(sorted(places), sorted(places)[1:], strict=False)]
    if not scale or min(gaps) >= 0.08 * sum(gaps):  # closer ones would print over each other
        panel.set_xticks(list(places), [text if len(text) <= 12 else text[:11] + "…" for text in texts], parse_math=False)
    if column.key == "success":
        panel.set_ylim(-4, 104)
    elif column.key in ("cost", "mag"):
        panel.set_ylim(bottom=-0.03 * panel.get_ylim()[1])  # Human-only deviates by 0, and must show above the frame
    panel.grid(color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)


def _gaps(assistants: dict[str, list[Curve]]) -> str:
    """What a reader must know of points that are not there."""
    missing = sum(line is None for found in assistants.values() for curve in found for line in curve.lines)
    return f" (cells are missing: {missing} point{'s' if missing > 1 else ''} left out)" if missing else ""


def _assistant(line: Line) -> tuple[str, str]:
    return line.group.method, line.group.assistant_variant


def _title(assistant: tuple[str, str]) -> str:
    return who_title(*assistant)
