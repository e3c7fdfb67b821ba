"""The figures of methods: cost against return, the effect of interventions (Figure 3), and measures
over severities. A figure without data writes no file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.table import CellTable, Floats
from wasp_cli.methods.registry import METHODS
from wasp_cli.report.canvas import drawn, figure_files
from wasp_cli.report.stats import Frame, Group
from wasp_cli.report.styles import LINES, PALETTE, legend, ruled, style_of
from wasp_cli.report.summary import UNDEFINED, Value, summarise
from wasp_cli.report.tables import Column, assistant_title, operator_title, task_title
from wasp_cli.report.tables.comparison import MEANS, estimated, judged_groups
from wasp_cli.report.tables.main import PAPER_COLUMNS, has_severity

if TYPE_CHECKING:
    from matplotlib.axes import Axes


CAPTIONS = {  # by the name of the file, in the order of the page
    "cost_return": "Cost against return of every method: large marks are means over the operators, "
    "with the spread over seeds, small ones single operators.",
    "cost_interventions": "Cost against the share of decisions at which an action changed a force: "
    "assistants are comparable on one vertical line. Bars are hierarchical 95 % intervals over "
    "trainings and worlds; the line across is the cost of the operators alone, with its interval.",
    "figure3": "What the interventions were worth: how many costly decisions would have followed "
    "without them, and what they changed; bars are the limits of the table.",
    "gains": "What the predictions were worth: at a predicted gain of x (dashed: as predicted) an "
    "intervention gained y on average; bars are 95 % intervals over worlds, numbers count "
    "interventions, the dotted line is τ_r, and predictions hold in the shaded part.",
    "severity": "Return, cost and intervention rate under every operator and severity; bars are "
    "standard deviations over seeds.",
    "profile": "Performance profiles: the share of episodes that return at least x, and that cost "
    "at most x; every operator and seed weighs the same.",
    "operating_points": "What assistants change on held-out worlds, against how often they act: "
    "return and cost beside those of the operators alone in the same worlds, a mark for each value "
    "of a knob. The ring is what was chosen; at a rate of 0 the assistant is silent.",
    "learning": "Learning curves: of the parts that learn in the task, and the losses of the world "
    "model (means of neighbouring points).",
    "reliability": "The share of imagined steps that really cost, over the probability of a cost "
    "that the world model predicts.",
}


def rows_by_task(frame: Frame) -> dict[str, list[Group]]:
    """Return the rows that figures draw, by task: full methods (no ablations) with at least one
    cell.
    """
    drawable = [group for group in frame.groups if group.variant == "full" and len(group.cells)]
    return {task: list(own) for task, own in groupby(drawable, lambda group: group.task)}


def cost_return_figure(frame: Frame, folder: Path) -> list[Path]:
    """Write `cost_return.png` and `.svg`: the mean cost and return of each method, with a panel for
    each task. Returns the files; none if no method has a cell.
    """
    tasks = rows_by_task(frame)
    if not tasks:
        return []
    with drawn((1.6 + 3.4 * len(tasks), 3.6)) as figure:
        panels = figure.subplots(1, len(tasks), squeeze=False)[0]
        for panel, (task, rows) in zip(panels, tasks.items(), strict=True):
            for group in rows:
                _draw(panel, group)
            panel.set_title(task_title(task), loc="left", fontweight="bold")
            panel.set_xlabel("Cost per episode (better: left)")
            ruled(panel)
        panels[0].set_ylabel("Return per episode (better: up)")
        legend(
            figure, panels, loc="outside right upper", title="large: mean\nsmall: one operator\n"
        )
        return figure_files(figure, folder, "cost_return")


def profile_figure(frame: Frame, folder: Path) -> list[Path]:
    """Write `profile.png` and `.svg`: performance profiles (Agarwal et al. 2021) of return and
    cost. Returns the files.
    """
    tasks = rows_by_task(frame)
    names = list(METHODS)
    if not tasks:
        return []
    with drawn((1.8 + 3.2 * len(tasks), 5.6)) as figure:
        panels = figure.subplots(2, len(tasks), squeeze=False, sharey=True)
        for column, (task, rows) in zip(panels.T, tasks.items(), strict=True):
            for group, (panel, key) in product(rows, zip(column, ("return", "cost"), strict=True)):
                x, share = profile(group, key, at_least=key == "return")
                place = names.index(group.method) // len(PALETTE) if group.method in names else -1
                look = {
                    "color": style_of(group.method)[0],
                    "linestyle": LINES[place % len(LINES)],
                    "linewidth": 1.3,
                }
                panel.step(
                    x,
                    share,
                    where="post" if key == "cost" else "pre",
                    label=assistant_title(group),
                    **look,
                )
            column[0].set_title(task_title(task), loc="left", fontweight="bold")
            column[0].set_xlabel("return x of an episode (better: up)")
            column[1].set_xlabel("cost x of an episode (better: up)")
            for panel in column:
                panel.set_ylim(0.0, 1.02)
                ruled(panel)
        column = panels[:, 0]
        column[0].set_ylabel("share of episodes that return ≥ x")
        column[1].set_ylabel("share of episodes that cost ≤ x")
        legend(figure, panels[0], loc="outside right upper")
        return figure_files(figure, folder, "profile")


def profile(group: Group, key: str, *, at_least: bool) -> tuple[Floats, Floats]:
    """Return values x [N] in their order, and the share [N] of episodes with at least x, or at
    most x; every cell weighs the same.
    """
    cells = group.cells
    values = cells.episodes(key)
    weights = (1.0 / cells.counts)[cells.place] / len(cells)
    order = np.argsort(values, kind="stable")
    x = values[order]
    reached = np.cumsum(weights[order])
    return x, 1.0 - reached + weights[order] if at_least else reached


def _draw(panel: Axes, group: Group) -> None:
    colour, marker = style_of(group.method)
    x, y = _point(group.cells)
    operators = dict.fromkeys(cell.operator for cell in group.cells)
    if not METHODS[group.method].impaired:
        operators = {}
    for operator in operators:
        small_x, small_y = _point(group.of_operator(operator))
        panel.plot([x, small_x], [y, small_y], color=colour, alpha=0.25, linewidth=0.8)
        panel.plot(
            small_x, small_y, marker, color=colour, markersize=4, alpha=0.55, markeredgewidth=0
        )
    cost_sd = summarise(group.cells, "cost").sd
    return_sd = summarise(group.cells, "return").sd
    # Human-only is larger, so that it stays visible behind an assistant that never acts.
    size = 12 if group.method == "human" else 9
    panel.errorbar(
        x,
        y,
        xerr=cost_sd,
        yerr=return_sd,
        fmt=marker,
        color=colour,
        markersize=size,
        markeredgecolor="white",
        capsize=2,
        elinewidth=1,
        label=assistant_title(group),
    )


def _point(cells: CellTable) -> tuple[float, float]:
    cost = summarise(cells, "cost").mean
    reward = summarise(cells, "return").mean
    return (math.nan if cost is None else cost, math.nan if reward is None else reward)


CLASSES = (
    ("no cost", "#f2f2f2"),
    ("up to 1/3", "#bdbdbd"),
    ("up to 2/3", "#737373"),
    ("more", "#1a1a1a"),
)
"""Classes of the risk ρ, by the share of the W decisions that cost. Darker greys are higher risks,
which can be told apart in black and white.
"""
PANELS = {
    "uir": "Unnecessary: UIR (better: left;\nhollow: branches swapped)",
    "delta_c": "Costly decisions\navoided: ΔC (better: right)",
    "delta_r": "Reward gained: ΔR\n(better: right)",
}


def necessity_figure(frame: Frame, folder: Path) -> list[Path]:
    """Write `figure3.png` and `.svg`, after the paper's Figure 3: the interventions of each
    assistant by the risk of the command alone, and UIR, ΔC and ΔR with their intervals. Returns the
    files; none if no intervention was branched.
    """
    drawable = [
        group
        for group in judged_groups(frame)
        if any(frame.judged[cell.key].worth.rho.size for cell in group.cells)
    ]
    if not drawable:
        return []
    tasks = [(task, list(own)) for task, own in groupby(drawable, lambda group: group.task)]
    columns = {column.key: column for column in MEANS}
    heights = [0.34 * len(own) + 0.5 for _, own in tasks]
    with drawn((10.0, 1.3 + sum(heights))) as figure:
        panels = figure.subplots(
            len(tasks),
            1 + len(PANELS),
            squeeze=False,
            sharey="row",
            width_ratios=[1.7, 1, 1, 1],
            height_ratios=heights,
        )
        for row, (task, own) in zip(panels, tasks, strict=True):
            risk, *others = row
            _risk_panel(risk, frame, own)
            risk.set_title(task_title(task), loc="left", fontweight="bold")
            for panel, key in zip(others, PANELS, strict=True):
                _points(panel, own, columns[key], columns["uir_swapped"] if key == "uir" else None)
        labels = (
            "Share of the interventions by the risk ρ\nof the command alone",
            *PANELS.values(),
        )
        for panel, label in zip(panels[-1], labels, strict=True):
            panel.set_xlabel(label)
        windows = " or ".join(map(str, sorted({judged.window for judged in frame.judged.values()})))
        rho = f"ρ: share of the next {windows} decisions that cost without the intervention"
        legend(figure, [panels[0, 0]], most=len(CLASSES), loc="outside lower left", title=rho)
        return figure_files(figure, folder, "figure3")


def _risk_panel(panel: Axes, frame: Frame, own: Sequence[Group]) -> None:
    """Stack the shares of the classes of risk, each the mean over seeds of the means of cells,
    as in the table (`summarise`).
    """
    edges = np.array([0.0, 1 / 3, 2 / 3])
    for y, group in enumerate(own):
        # By seed, the shares of the classes in each of its cells.
        by_seed: dict[int, list[Floats]] = {}
        for cell in group.cells:
            risks = frame.judged[cell.key].worth.rho
            if len(risks):
                # A risk k / W that lies on an edge belongs to the class below it.
                place = np.searchsorted(edges, risks - 1e-9, side="left")
                by_seed.setdefault(cell.seed, []).append(
                    np.bincount(place, minlength=len(CLASSES)) / len(risks)
                )
        # One bar, stacked of the mean shares.
        left = 0.0
        total = sum(frame.judged[cell.key].worth.rho.size for cell in group.cells)
        shares = 100.0 * np.mean([np.mean(cells, 0) for cells in by_seed.values()], 0)
        for (name, grey), share in zip(CLASSES, shares.tolist(), strict=True):
            panel.barh(
                y,
                share,
                0.62,
                left=left,
                color=grey,
                edgecolor="black",
                linewidth=0.6,
                label=name if y == 0 else None,
            )
            left += share
        panel.annotate(
            f"n = {total}",
            (100.0, y),
            (4, 0),
            textcoords="offset points",
            va="center",
            fontsize=7,
            color="#555555",
        )
    panel.set_xlim(0.0, 116.0)
    panel.set_xticks(range(0, 101, 25), [f"{tick} %" for tick in range(0, 101, 25)])
    panel.set_yticks(range(len(own)), [assistant_title(group) for group in own])
    panel.set_ylim(len(own) - 0.5, -0.5)
    panel.tick_params(axis="y", length=0)


def _points(panel: Axes, own: Sequence[Group], column: Column, beside: Column | None) -> None:
    """A mark per method with its interval, and a hollow one for the column `beside`."""
    for y, group in enumerate(own):
        value = estimated(group, column)
        if value.mean is None:
            continue
        colour, marker = style_of(group.method)
        if value.interval is not None:
            panel.plot(
                [value.interval.low, value.interval.high],
                [y, y],
                color=colour,
                linewidth=1.6,
                solid_capstyle="butt",
            )
        other = estimated(group, beside).mean if beside else None
        if other is not None:
            panel.plot(
                other, y, marker, markersize=7, markerfacecolor="none", markeredgecolor=colour
            )
        panel.plot(value.mean, y, marker, color=colour, markersize=8, markeredgecolor="white")
    if column.key == "uir":
        panel.set_xlim(-0.05, 1.05)  # so that a mark at an end is whole
        panel.set_xticks([0.0, 0.5, 1.0])
    else:
        panel.locator_params(axis="x", nbins=4)
        panel.axvline(0.0, color="black", linewidth=0.8)
    panel.spines["left"].set_visible(False)
    ruled(panel, "x")
    panel.tick_params(axis="y", length=0)


SEVERITY_MEASURES = tuple(
    column for column in PAPER_COLUMNS if column.key in ("int_rate", "cost", "return")
)
Condition = tuple[str, float | str]
"""Operator and severity: its value, or its name where trainings have different values of it."""


def severity_figure(frame: Frame, folder: Path) -> list[Path]:
    """Write `severity.png` and `.svg`: return, cost and intervention rate over the severities of
    each operator. Returns the files; none if no operator has two severities.
    """
    assistants = [
        group
        for rows in rows_by_task(frame).values()
        for group in rows
        if METHODS[group.method].impaired
    ]
    place_of = _places([cell for cell in frame.cells if has_severity(cell)])
    under = dict.fromkeys(place_of.values())
    variants = list(dict.fromkeys(variant for variant, _ in under))
    conditions = sorted(under, key=lambda condition: variants.index(condition[0]))
    tasks = list(dict.fromkeys(group.task for group in assistants))
    if not tasks or len(conditions) == len(variants):
        return []  # no operator has two severities: the table of operators says the same
    with drawn((max(7.5, 2.2 + 0.9 * len(conditions)), 0.6 + 2.9 * len(tasks))) as figure:
        panels = figure.subplots(len(tasks), len(SEVERITY_MEASURES), squeeze=False, sharex=True)
        for row, task in zip(panels, tasks, strict=True):
            shown = [group for group in assistants if group.task == task]
            for panel, column in zip(row, SEVERITY_MEASURES, strict=True):
                for i, group in enumerate(shown):
                    # Methods stand beside each other, so that none hides another.
                    shift = 0.5 * (i / max(len(shown) - 1, 1) - 0.5)
                    _draw_severities(panel, group, conditions, place_of, column, shift)
                panel.set_title(f"{task_title(task)}: {column.heading}", loc="left", fontsize=9)
                _name_conditions(panel, conditions)
        legend(figure, panels.flat, loc="outside lower center", most=7)
        return figure_files(figure, folder, "severity")


def _places(cells: Sequence[RecordedCell]) -> dict[RecordedCell, Condition]:
    """The condition of each cell. If a severity was chosen for each training, cells with the same
    name of a severity have different values, and are drawn at one place.
    """
    values: dict[tuple[str, str | None], set[float | None]] = {}
    for cell in cells:
        values.setdefault((cell.operator, cell.severity), set()).add(cell.value)
    conditions: dict[RecordedCell, Condition] = {}
    for cell in cells:
        together = len(values[cell.operator, cell.severity]) > 1
        if together and cell.severity is not None:
            conditions[cell] = cell.operator, cell.severity
        elif cell.value is not None:
            conditions[cell] = cell.operator, cell.value
    return conditions


def _draw_severities(
    panel: Axes,
    group: Group,
    conditions: Sequence[Condition],
    place_of: Mapping[RecordedCell, Condition],
    column: Column,
    shift: float,
) -> None:
    x: list[float] = []
    values: list[Value] = []
    for _, places in groupby(enumerate(conditions), key=lambda place: place[1][0]):
        for place, condition in places:
            of_cells = [place_of.get(cell) == condition for cell in group.cells]
            cells = group.cells.choose(np.array(of_cells, bool))
            x.append(place + shift)
            values.append(summarise(cells, column.key))
        # A gap between operators, so that all are drawn as one line: each further line would take
        # as long to draw as this one.
        x.append(x[-1])
        values.append(UNDEFINED)
    means = [_scaled(value.mean, column) for value in values]
    spreads = [_scaled(value.sd, column) for value in values]
    colour, marker = style_of(group.method)
    bars = spreads if any(number > 0 for number in spreads) else None
    panel.errorbar(
        x,
        means,
        yerr=bars,
        fmt=marker,
        linestyle="-",
        color=colour,
        markersize=4,
        linewidth=0.9,
        elinewidth=0.8,
        label=assistant_title(group),
    )


def _scaled(number: float | None, column: Column) -> float:
    """A number in the unit that a column is shown in; NaN where it is undefined."""
    return math.nan if number is None else number * column.scale


def _name_conditions(panel: Axes, conditions: Sequence[Condition]) -> None:
    names = []
    for operator, severity in conditions:
        text = severity if isinstance(severity, str) else f"{severity:g}"
        names.append(f"{operator_title(operator)} {text}")
    panel.set_xticks(range(len(conditions)), names, rotation=35, ha="right", fontsize=7)
    ruled(panel, "y")
    panel.set_ylim(bottom=min(0.0, panel.get_ylim()[0]))
    for i, (left, right) in enumerate(pairwise(conditions)):
        if left[0] != right[0]:
            panel.axvline(i + 0.5, color="#bbbbbb", linewidth=0.6)
