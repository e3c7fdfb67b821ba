"""Figure 3 as a table: per task and method what the interventions were worth (section 5.3 of the paper)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import PERSON
from wasp_cli.report.stats.bootstrap import mean_of
from wasp_cli.report.stats.frame import Frame, Group, groups, row_of
from wasp_cli.report.stats.summary import UNDEFINED, Value
from wasp_cli.report.tables.comparison import limit_notes
from wasp_cli.report.tables.main import labels_of, part_of
from wasp_cli.report.tables.table import Column, Row, Table, task_title

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
MEANINGS = (
    "At an intervention the real episode goes on twice for W decisions from the same state, with the same mistakes of the operator: with "
    "the method's action first, and with the operator's command first; then the operator drives alone in both.",
    "ρ is the mean cost per decision without the intervention (Eq. 19), ΔC the costly decisions that it avoided, ΔR the reward that it "
    "gained (Eq. 20). UIR is the share of the interventions that avoided no cost and gained no more than τ_R (Eq. 21).",
    "UIR swapped asks the same of the command, with the branches in each other's place: interventions that help as often as they harm have "
    "the same in both. UIR eff. leaves out interventions whose branches are alike in every step: they changed nothing.",
    "One action is tested, not the assistance as a whole: the branch with the intervention goes on without any further one.",
)


def necessity_table(frame: Frame) -> Table | None:
    """Make table `figure3`; None where no interventions were to be branched."""
    found = list(judged_groups(frame))
    if not found:
        return None
    rows = [Row(labels_of(group), (*_counts(frame, group), *(estimated(group, column) for column in MEANS))) for group in found]
    columns, notes = (INTERVENTIONS, BRANCHED, *MEANS), tuple(_notes(frame, rows))
    return Table("figure3", "Were the interventions necessary?", ("Task", "Method"), columns, tuple(rows), notes, MEANINGS)


def judged_groups(frame: Frame) -> Iterator[Group]:
    """Yield the rows whose interventions were to be branched, each with the cells that have branches; the others are absent."""
    gaps = Counter(row_of(gap.identity) for gap in frame.unbranched)
    for group in groups(frame):
        cells = tuple(cell for cell in group.cells if cell.identity in frame.judged)
        if cells or gaps[group.task, group.method, group.variant]:
            yield replace(group, cells=cells, absent=group.absent + len(group.cells) - len(cells))


def estimated(group: Group, column: Column) -> Value:
    """Return a column of a row with its interval."""
    estimate = mean_of(group.cells, column.key) if group.cells else None
    value = part_of(group, group.cells, column)
    return value if estimate is None else replace(value, interval=estimate.interval)


def _counts(frame: Frame, group: Group) -> tuple[Value, Value]:
    """Interventions of the row, and how many of them were branched."""
    if not group.cells:
        return UNDEFINED, UNDEFINED
    seeds = len({cell.identity.seed for cell in group.cells})
    interventions = sum(cell.episodes["intervened"].sum() for cell in group.cells)
    branched = sum(len(frame.judged[cell.identity].episode) for cell in group.cells)
    return Value(float(interventions), n=seeds, ranked=False), Value(float(branched), n=seeds, ranked=False)


def _notes(frame: Frame, rows: Sequence[Row]) -> Iterator[str]:
    if frame.judged:
        yield f"{_thresholds(frame)}."
        yield from limit_notes(rows)
        if any(identity.operator == PERSON for identity in frame.judged):
            yield "Of people's sessions: from a branch on the participant's clone drives, since nobody can be asked again."
        branched: Counter[str] = Counter()
        for identity, judged in frame.judged.items():
            branched[identity.method] += len(judged.episode)
        few = [METHODS[name].title for name, count in branched.items() if count < FEW]
        if few:
            yield f"Fewer than {FEW} interventions were branched of {', '.join(few)}: too few to interpret."
    if frame.unbranched:
        have = "cell has" if len(frame.unbranched) == 1 else "cells have"
        yield (
            f"INCOMPLETE: {len(frame.unbranched)} {have} no counterfactual branches. "
            "Rows with [x of y cells] are partial and never marked best."
        )


def _thresholds(frame: Frame) -> str:
    windows = " and ".join(map(str, sorted({judged.window for judged in frame.judged.values()})))
    gains: dict[str, list[float]] = {}
    for identity, judged in frame.judged.items():
        gains.setdefault(identity.task, []).append(judged.tau_R)
    spans = {task: (f"{min(values):.3f}", f"{max(values):.3f}") for task, values in gains.items()}
    named = (f"{low if low == high else f'{low} to {high}'} on {task_title(task)}" for task, (low, high) in spans.items())
    return f"W = {windows} decisions, τ_R = {', '.join(named)}"
