"""Tables with intervals: how the methods compare with the operators alone, and Figure 3: what
the interventions were worth.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import PERSON
from wasp_cli.report.bootstrap import (
    RESAMPLES,
    Estimate,
    difference_of,
    improvement_over,
    iqm_of,
    mean_of,
)
from wasp_cli.report.stats import Frame, Group, row_of
from wasp_cli.report.summary import UNDEFINED, Value
from wasp_cli.report.tables import Column, Row, Table, task_title
from wasp_cli.report.tables.main import (
    PAPER_COLUMNS,
    full_groups,
    labels_of,
    missing_notes,
    part_of,
)

REFERENCE = "human"
MEASURES = tuple(
    column for column in PAPER_COLUMNS if column.key in ("return", "success", "cost", "viol")
)
PROBABILITY = Column("improvement", "P(better)")
MEANINGS = (
    "Mean is that of the main table. IQM is the mean of the middle half of the cells "
    "(operator variants x severities x seeds): one "
    "cell that is far off does not carry it. The difference is paired, over the operators, "
    "severities and seeds that both have.",
    "P(better) is the probability that an episode is better than one of the reference "
    "under the same operator, severity and seed, "
    "ties one half: 0.5 is no difference.",
)


def comparison_table(frame: Frame) -> Table | None:
    """Make table `statistics`: mean, interquartile mean, paired difference to Human-only and
    probability of improvement over it.
    """
    # A row for each task, measure and method, beside the operators alone where they are there.
    rows: list[Row] = []
    referred = False
    for _, of_task in groupby(full_groups(frame), lambda group: group.task):
        methods = list(of_task)
        alone = None
        for group in methods:
            if group.method == REFERENCE and len(group.cells):
                alone = group
        referred |= alone is not None
        rows += [_row(group, measure, alone) for measure in MEASURES for group in methods]
    if not len(frame.cells):
        return None

    # What the intervals are.
    difference = Column("difference", f"Difference to {METHODS[REFERENCE].title}", signed=True)
    columns = (Column("mean", "Mean"), Column("iqm", "IQM"), difference, PROBABILITY)
    lonely: list[str] = []
    if not referred:
        lonely.append("The reference has no cells here, so that nothing is compared with it.")
    many = sum(value.interval is not None for row in rows for value in row.values)
    if many:
        counted = (
            f"These are {many} intervals; of so many some miss even where nothing differs. "
            "Decide beforehand which comparison counts."
        )
        said = [*limit_notes(rows), counted]
    else:
        said = [
            "No intervals: there is a single world to resample, or the trainings have "
            "cells of different operators."
        ]
    notes = (*said, *lonely, *missing_notes(frame))
    labels = ("Task", "Measure", "Method")
    return Table(
        "statistics",
        "Confidence intervals",
        labels,
        columns,
        tuple(rows),
        notes,
        MEANINGS,
        grouping=2,
    )


def _row(group: Group, measure: Column, alone: Group | None) -> Row:
    cells = group.cells
    key = measure.key
    better = measure.better
    marked = part_of(group, cells, measure)  # as in the main table
    numbers = _value(mean_of(cells, key), marked), _value(iqm_of(cells, key), marked)
    compared = (UNDEFINED, UNDEFINED)
    if alone is not None and alone is not group and better is not None:
        plain = replace(marked, ranked=False)
        wins = improvement_over(cells, alone.cells, key, better)
        compared = _value(difference_of(cells, alone.cells, key), plain), _value(wins, plain)
    task, method = labels_of(group)
    columns = (measure, measure, replace(measure, signed=True), PROBABILITY)
    return Row(
        (task, measure.heading, method), (*numbers, *compared), columns, names=(task, key, method)
    )


def _value(estimate: Estimate | None, like: Value) -> Value:
    return (
        UNDEFINED
        if estimate is None
        else Value(estimate.value, n=like.n, ranked=like.ranked, interval=estimate.interval)
    )


def limit_notes(rows: Sequence[Row]) -> Iterator[str]:
    """Yield what [low, high] are, what they resample and how coarse that is."""
    intervals = {
        value.interval.words: value.interval
        for row in rows
        for value in row.values
        if value.interval is not None
    }
    for words, interval in sorted(intervals.items()):
        if interval.unit == "world":
            what = "worlds of one training: they cover other layouts, not retraining"
        else:
            n = interval.clusters
            coarse = ", so they are coarse" if n < 6 else ""
            what = (
                f"trainings, each with its models and worlds; {math.comb(2 * n - 1, n):,} "
                f"resamples differ{coarse}"
            )
        yield f"[low, high]: {words}, by a bootstrap with {RESAMPLES} resamples of the {what}."


INTERVENTIONS = Column("interventions", "Int. steps", digits=0, spread=False)
BRANCHED = Column("branched", "Branched", digits=0, spread=False)
MEANS = (
    Column("rho", "ρ", digits=3),
    Column("at_risk", "ρ > 0 (%)", digits=1, scale=100.0, spread=False, optional=True),
    Column("delta_c", "ΔC", "up", signed=True),
    Column("delta_r", "ΔR", "up", digits=3, signed=True),
    Column("uir", "UIR", "down"),
    Column("uir_swapped", "UIR swapped", optional=True),
    Column("uir_eff", "UIR eff.", "down", optional=True),
)
FEW = 30  # branched interventions below which a note warns
NECESSITY_MEANINGS = (
    "At an intervention the real episode goes on twice for W decisions from the same "
    "state, with the same mistakes of the operator: with "
    "the method's action first, and with the operator's command first; then the operator "
    "drives alone in both.",
    "ρ is the mean cost per decision without the intervention (Eq. 19), ΔC the costly "
    "decisions that it avoided, ΔR the reward that it "
    "gained (Eq. 20). UIR is the share of the interventions that avoided no cost and "
    "gained no more than τ_R (Eq. 21).",
    "UIR swapped asks the same of the command, with the branches in each other's place: "
    "interventions that help as often as they harm have "
    "the same in both. UIR eff. leaves out interventions whose branches are alike in every "
    "step: they changed nothing.",
    "One action is tested, not the assistance as a whole: the branch with the intervention "
    "goes on without any further one.",
)


def necessity_table(frame: Frame) -> Table | None:
    """Make table `figure3`: per assistant how many interventions were branched, and the means of
    Eq. 19 to 21 over them; None where no cell was to be branched.
    """
    judged = list(judged_groups(frame))
    if not judged:
        return None
    rows = [
        Row(
            labels_of(group),
            (*_counts(frame, group), *(estimated(group, column) for column in MEANS)),
        )
        for group in judged
    ]
    columns, notes = (INTERVENTIONS, BRANCHED, *MEANS), tuple(_notes(frame, rows))
    return Table(
        "figure3",
        "Were the interventions necessary?",
        ("Task", "Method"),
        columns,
        tuple(rows),
        notes,
        NECESSITY_MEANINGS,
    )


def judged_groups(frame: Frame) -> Iterator[Group]:
    """Yield the rows whose interventions were to be branched, each with the cells that have
    branches; the others are absent.
    """
    gaps = Counter(row_of(gap.cell) for gap in frame.unbranched)
    for group in frame.groups:
        cells = group.cells.where(lambda cell: cell.key in frame.judged)
        if len(cells) or gaps[group.assistant]:
            yield replace(group, cells=cells, absent=group.absent + len(group.cells) - len(cells))


def estimated(group: Group, column: Column) -> Value:
    """Return the number of a row with its 95 % interval."""
    estimate = mean_of(group.cells, column.key) if len(group.cells) else None
    value = part_of(group, group.cells, column)
    return value if estimate is None else replace(value, interval=estimate.interval)


def _counts(frame: Frame, group: Group) -> tuple[Value, Value]:
    if not len(group.cells):
        return UNDEFINED, UNDEFINED
    seeds = len(np.unique(group.cells.seeds))
    interventions = group.cells.episodes("intervened").sum()
    branched = sum(len(frame.judged[cell.key].episode) for cell in group.cells)
    return Value(float(interventions), n=seeds, ranked=False), Value(
        float(branched), n=seeds, ranked=False
    )


def _notes(frame: Frame, rows: Sequence[Row]) -> Iterator[str]:
    if frame.judged:
        # What the branches were judged by.
        windows = " and ".join(
            map(str, sorted({judged.window for judged in frame.judged.values()}))
        )
        of_cells = [
            (cell, frame.judged[cell.key]) for cell in frame.cells if cell.key in frame.judged
        ]
        gains: dict[str, list[float]] = {}
        for cell, judged in of_cells:
            gains.setdefault(cell.task, []).append(judged.tau_R)
        spans = {
            task: (f"{min(values):.3f}", f"{max(values):.3f}") for task, values in gains.items()
        }
        named = (
            f"{low if low == high else f'{low} to {high}'} on {task_title(task)}"
            for task, (low, high) in spans.items()
        )
        yield f"W = {windows} decisions, τ_R = {', '.join(named)}."

        # What limits what they say.
        yield from limit_notes(rows)
        if any(cell.operator == PERSON for cell, _ in of_cells):
            yield (
                "Of people's sessions: from a branch on the participant's clone drives, since "
                "nobody can be asked again."
            )
        branched: Counter[str] = Counter()
        for cell, judged in of_cells:
            branched[cell.method] += len(judged.episode)
        few = [METHODS[name].title for name, count in branched.items() if count < FEW]
        if few:
            yield (
                f"Fewer than {FEW} interventions were branched of {', '.join(few)}: too few to "
                "interpret."
            )
    if frame.unbranched:
        have = "cell has" if len(frame.unbranched) == 1 else "cells have"
        yield (
            f"INCOMPLETE: {len(frame.unbranched)} {have} no counterfactual branches. "
            "Rows with [x of y cells] are partial and never marked best."
        )
