"""Check of the severities of the simulated operators, from Human-only beside the Expert: the rule, a table, and every number for machines.

The rule, for one task and one operator, on the return of Human-only:

    it falls from every severity to the next, in the order in which the spec writes them;
    the severity named `moderate` loses at least a quarter of the Expert's return.

Episodes are compared in pairs: their worlds depend on task, seed and episode alone, so that operators of all severities, and the
unimpaired one, meet the same worlds; the severities of one operator share its draws too. What less than two standard errors of these
pairs speak against the rule is undecided.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby, pairwise
from typing import Any, Literal, NamedTuple

import numpy as np

from wasp_cli.errors import NotAccepted
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.report.stats import CellNumbers, Frame, Wanted, read_frame
from wasp_cli.report.summary import UNDEFINED, Value, spread_note, summarise
from wasp_cli.report.tables.main import AUTONOMY, PAPER_COLUMNS, missing_notes
from wasp_cli.report.tables.table import Column, Row, Table, operator_title, task_title
from wasp_cli.spec.model import Spec
from wasp_cli.store.tables import CellIdentity

MODERATE = "moderate"  # name of the severity that is held against the expert
KEPT = 0.75  # share of the expert's return that it may keep
SURE = 2.0  # standard errors from which on a difference is not taken for chance

Outcome = Literal["not accepted", "undecided", "accepted", "incomplete"]
Returns = Mapping[tuple[int, int], float]  # return of each episode by its seed and its index


@dataclass(frozen=True, eq=False)
class SeverityLevel:
    """Human-only at one severity, or the Expert."""

    severity: str | None  # its name in the spec; None of the Expert
    value: float | None
    returns: Returns
    cells: tuple[CellNumbers, ...] = ()  # one for each seed
    absent: int = 0  # cells that are missing

    @property
    def title(self) -> str:
        """`moderate 0.7`; empty for the Expert."""
        return "" if self.severity is None or self.value is None else f"{self.severity} {self.value:g}"

    @property
    def mean(self) -> float:
        return float(np.mean(list(self.returns.values()))) if self.returns else math.nan


@dataclass(frozen=True)
class Difference:
    """Mean of a paired difference."""

    mean: float
    se: float | None  # standard error of the mean over the pairs; None for a single pair
    pairs: int

    @property
    def sure(self) -> bool:
        """Whether a mean that is not negative is no chance; nothing is sure of a single pair."""
        return self.se is not None and self.mean >= SURE * self.se

    def __str__(self) -> str:
        if self.se is None:
            return f"{number(self.mean)} in the only episode"
        digits = max(1, math.ceil(-math.log10(self.se))) if self.se > 0 else 1  # the first that the standard error has
        return f"{self.mean:.{digits}f} +- {self.se:.{digits}f}"


@dataclass(frozen=True, eq=False)
class SeverityCheck:
    """One operator on one task, from mild to severe, beside the Expert."""

    task: str
    operator: str
    expert: SeverityLevel
    levels: tuple[SeverityLevel, ...]  # one for each severity, in the order of the spec

    @property
    def absent(self) -> int:
        return self.expert.absent + sum(level.absent for level in self.levels)

    @property
    def moderate(self) -> SeverityLevel | None:
        """The severity that is held against the expert: that of this name, or the middle one; None where there is neither."""
        named = [level for level in self.levels if level.severity == MODERATE]
        if named or len(self.levels) % 2 == 0:
            return named[0] if named else None
        return self.levels[len(self.levels) // 2]

    def changes(self) -> list[Difference | None]:
        """Return per severity the return less that of the next milder one (the first: of the Expert); None without a common episode."""
        return [difference(level.returns, milder.returns) for milder, level in pairwise((self.expert, *self.levels))]

    def share(self, level: SeverityLevel) -> float | None:
        """Return the share of the expert's return that a level keeps, over the episodes of both; None where that return is not positive."""
        common = level.returns.keys() & self.expert.returns.keys()
        expert = sum(self.expert.returns[episode] for episode in sorted(common))
        return sum(level.returns[episode] for episode in sorted(common)) / expert if expert > 0 else None


class Verdict(NamedTuple):
    """What the rule, or one part of it, says of a check, and why."""

    outcome: Outcome
    reason: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.outcome}: {self.reason}"


_REMEDY = {"not accepted": "rescale it in the spec", "undecided": "more episodes or seeds"}


def difference(returns: Returns, reference: Returns, share: float = 1.0) -> Difference | None:
    """Return mean and standard error of `returns - share * reference` over the episodes that both have; None without any."""
    common = sorted(returns.keys() & reference.keys())
    if not common:
        return None
    values = np.array([returns[episode] - share * reference[episode] for episode in common])
    se = float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else None
    return Difference(float(np.mean(values)), se, len(values))


def judge(check: SeverityCheck) -> Verdict:
    """Hold a check against the rule; of several findings the worst ones count."""
    if check.absent:
        return Verdict("incomplete", f"{check.absent} of its cells, or of the expert's, {'are' if check.absent > 1 else 'is'} missing")
    findings = [*_steps(check), _loss(check)]
    outcomes: tuple[Outcome, ...] = ("not accepted", "undecided", "accepted")
    worst = min((finding.outcome for finding in findings), key=outcomes.index)
    named = [finding for finding in findings if finding.outcome == worst]
    advice = dict.fromkeys(finding.advice for finding in named if finding.advice)
    return Verdict(worst, ": ".join(filter(None, ("; ".join(finding.reason for finding in named), ", ".join(advice)))))


def _steps(check: SeverityCheck) -> Iterator[Verdict]:
    """What speaks against a return that falls with the severity; the step from the expert to the first one is not part of it."""
    if len(check.levels) == 1:
        yield Verdict("accepted", "only one severity; trend not tested")
        return
    falls = True
    for milder, level in pairwise(check.levels):
        change = difference(level.returns, milder.returns)
        if change is None:  # the cells of a plan have the same episodes
            raise ValueError(f"{check.task} {check.operator}: no episode is in both {milder.title} and {level.title}")
        if change.mean < 0:
            continue
        falls = False
        outcome: Outcome = "not accepted" if change.sure else "undecided"
        if outcome == "undecided":
            text = f"from {milder.title} to {level.title} it rises by {change}, which may be chance"
        elif change.mean == 0:
            text = f"stays at {number(level.mean)} from {milder.title} to {level.title}"
        else:
            text = f"rises from {number(milder.mean)} ({milder.title}) to {number(level.mean)} ({level.title}), {change}"
        yield Verdict(outcome, text, _REMEDY[outcome])
    if falls:
        yield Verdict("accepted", "falls at every step")


def _loss(check: SeverityCheck) -> Verdict:
    level = check.moderate
    if level is None:
        return Verdict("accepted", f"how much it loses is not judged: {without_moderate(check)}")
    share, above = check.share(level), difference(level.returns, check.expert.returns, KEPT)
    if above is None:
        raise ValueError(f"{check.task} {check.operator}: no episode is in both {level.title} and the expert")
    if share is None:
        text = f"the expert's return is {number(check.expert.mean)}, so that no share of it is defined"
        return Verdict("undecided", text, "train the expert longer")
    keeps = f"{level.severity} keeps {100 * share:.0f} % of the expert's return"
    if above.mean <= 0:
        return Verdict("accepted", keeps)
    keeps += f", {above} above {100 * KEPT:.0f} % of it"
    if above.sure:
        return Verdict("not accepted", keeps, _REMEDY["not accepted"])
    return Verdict("undecided", f"{keeps}, which may be chance", _REMEDY["undecided"])


def without_moderate(check: SeverityCheck) -> str:
    """Say why no severity of a check is held against the expert."""
    return f"none of {len(check.levels)} severities is named {MODERATE}, and none is in the middle"


def verdict_lines(checks: Sequence[SeverityCheck]) -> list[str]:
    """Return `goal1 laggy: accepted: falls at every step; moderate keeps 66 % of the expert's return`, for each check."""
    return [f"{check.task} {check.operator}: {judge(check)}" for check in checks]


def require_accepted(checks: Sequence[SeverityCheck]) -> None:
    """Raise NotAccepted when an operator does not keep the rule; what is undecided is no failure."""
    names = [f"{check.task} {check.operator}" for check in checks if judge(check).outcome == "not accepted"]
    if names:
        text = f"{len(names)} of {len(checks)} operators {'are' if len(names) > 1 else 'is'} not accepted: {', '.join(names)}"
        raise NotAccepted(text, "change its severities in the spec, and say so there")


def number(value: float) -> str:
    """Print a return as people read it: one decimal, or two digits where that says too little."""
    return f"{value:.1f}" if abs(value) >= 1 else f"{value:.2g}"


def read_checks(spec: Spec, wanted: Sequence[Wanted]) -> tuple[list[SeverityCheck], Frame]:
    """Return the checks of a spec, by task and then by operator, and the frame of its cells of Human-only and of the Expert."""
    frame = read_frame(wanted)
    return checks_of(spec, frame), frame


def checks_of(spec: Spec, frame: Frame) -> list[SeverityCheck]:
    """Return the checks in a frame, by task and then by operator, in the order of the spec."""
    numbers = {cell.identity: cell for cell in frame.cells}

    def level(task: str, method: str, variant: str, severity: str | None, value: float | None) -> SeverityLevel:
        identities = [CellIdentity(task, method, "full", variant, value, seed) for seed in spec.seeds]
        cells = tuple(numbers[identity] for identity in identities if identity in numbers)
        returns = {(cell.identity.seed, index): value for cell in cells for index, value in enumerate(cell.episodes["return"].tolist())}
        return SeverityLevel(severity, value, returns, cells, len(identities) - len(cells))

    checks = []
    for task in spec.tasks:
        expert = level(task, "expert", UNIMPAIRED, None, None)
        for variant, severities in spec.operators.items():
            levels = (level(task, "human", variant, name, value) for name, value in severities.items())
            checks.append(SeverityCheck(task, variant, expert, tuple(levels)))
    return checks


MEASURED = tuple(replace(column, optional=column.key in ("success", "viol")) for column in PAPER_COLUMNS if column.key not in AUTONOMY)
"""Of an operator alone: nobody intervenes."""
SHARE = Column("share", "of expert (%)", digits=1, scale=100.0, spread=False)
CHANGES = (Column("change", "Change", spread=False), Column("change_se", "SE", spread=False))
COLUMNS = (MEASURED[0], SHARE, *MEASURED[1:], *CHANGES)
CHANGE_NOTE = (
    "Change: mean difference of the return to the next milder severity, of the first to the Expert, in the same episodes; "
    "SE: its standard error over them."
)


def check_table(checks: Sequence[SeverityCheck], frame: Frame) -> Table:
    """Tabulate per task the Expert, then each operator variant at every severity."""
    rows: list[Row] = []
    for task, own in groupby(checks, lambda check: check.task):
        of_task = list(own)
        expert = of_task[0].expert
        labels = task_title(task), METHODS["expert"].title, _partial(expert)
        rows.append(Row(labels, _values(of_task[0], expert, None)))
        for check in of_task:
            for level, change in zip(check.levels, check.changes(), strict=True):
                labels = task_title(task), operator_title(check.operator), f"{level.title} {_partial(level)}".strip()
                rows.append(Row(labels, _values(check, level, change)))
    notes = (spread_note(frame.cells), *missing_notes(frame), CHANGE_NOTE, *_left_out(checks))
    return Table("severity_check", "Operators alone", ("Task", "Operator", "Severity"), COLUMNS, tuple(rows), notes, ranked=False)


def judged(table: Table, checks: Sequence[SeverityCheck]) -> Table:
    """Return the table with the verdicts below it."""
    return replace(table, notes=(*table.notes, *verdict_lines(checks)))


def as_json(name: str, checks: Sequence[SeverityCheck], frame: Frame) -> dict[str, Any]:
    """Return every number and verdict, null where undefined; `above` is what the moderate severity keeps beyond its share."""
    tasks = []
    for task, own in groupby(checks, lambda check: check.task):
        of_task = list(own)
        expert = of_task[0].expert
        tasks.append({"task": task, "expert": _numbers(of_task[0], expert), "operators": [_operator(check) for check in of_task]})
    return {"spec": name, "tasks": tasks, "missing": [{"cell": cell.label, "reason": cell.reason} for cell in frame.missing]}


def _operator(check: SeverityCheck) -> dict[str, Any]:
    verdict, moderate = judge(check), check.moderate
    changes = zip(check.levels, check.changes(), strict=True)
    above = None if moderate is None else difference(moderate.returns, check.expert.returns, KEPT)
    return {
        "operator": check.operator,
        "outcome": verdict.outcome,
        "reason": verdict.reason,
        "moderate": None if moderate is None else moderate.severity,
        "kept_at_most": KEPT,
        "above": above and asdict(above),
        "severities": [
            {"severity": level.severity, "value": level.value, **_numbers(check, level), "change": change and asdict(change)}
            for level, change in changes
        ],
    }


def _numbers(check: SeverityCheck, level: SeverityLevel) -> dict[str, Any]:
    numbers: dict[str, Any] = {"episodes": len(level.returns), "cells": len(level.cells), "missing": level.absent}
    for column in MEASURED:
        value = summarise(level.cells, column.key)
        numbers |= {column.key: value.mean, f"{column.key}_sd": value.sd}
    return {**numbers, "share": check.share(level)}


def _values(check: SeverityCheck, level: SeverityLevel, change: Difference | None) -> tuple[Value, ...]:
    first, *others = (summarise(level.cells, column.key) for column in MEASURED)
    changed = (UNDEFINED, UNDEFINED) if change is None else (Value(change.mean), Value(change.se))
    return (first, Value(check.share(level)), *others, *changed)


def _partial(level: SeverityLevel) -> str:
    """Says of how many cells a row is the mean, unless all are there."""
    return f"[{len(level.cells)} of {len(level.cells) + level.absent} cells]" if level.absent else ""


def _left_out(checks: Sequence[SeverityCheck]) -> Iterator[str]:
    for check in {check.operator: check for check in checks}.values():
        if check.moderate is None:
            yield f"{operator_title(check.operator)}: how much it loses is not judged, since {without_moderate(check)}."
    for check in {check.task: check for check in checks}.values():
        if check.expert.mean <= 0:
            yield f"{task_title(check.task)}: the expert's return is not positive, so that no share of it is defined."
