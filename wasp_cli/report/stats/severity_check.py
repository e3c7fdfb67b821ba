"""Check of the severities of the simulated operators, from Human-only beside the Expert.

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
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from wasp_cli.errors import NotAccepted
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.report.stats.frame import CellNumbers, Frame, Wanted, read_frame
from wasp_cli.spec.model import Spec
from wasp_cli.store.tables import CellIdentity

MODERATE = "moderate"
"""Name of the severity that is held against the expert."""
KEPT = 0.75
"""Share of the expert's return that it may keep."""
SURE = 2.0
"""Standard errors from which on a difference is not taken for chance."""

Outcome = Literal["not accepted", "undecided", "accepted", "incomplete"]
Returns = Mapping[tuple[int, int], float]
"""Return of each episode by its seed and its index."""


@dataclass(frozen=True, eq=False)
class SeverityLevel:
    """Human-only at one severity, or the Expert."""

    severity: str | None
    """Its name in the spec; None of the Expert."""
    value: float | None
    returns: Returns
    cells: tuple[CellNumbers, ...] = ()
    """One for each seed."""
    absent: int = 0
    """Cells that are missing."""

    @property
    def title(self) -> str:
        """`moderate 0.7`; empty for the Expert."""
        return "" if self.severity is None or self.value is None else f"{self.severity} {self.value:g}"

    @property
    def mean(self) -> float:
        """Mean return over the episodes; NaN without any."""
        return float(np.mean(list(self.returns.values()))) if self.returns else math.nan


@dataclass(frozen=True)
class Difference:
    """Mean of a paired difference."""

    mean: float
    se: float | None
    """Standard error of the mean over the pairs; None for a single pair."""
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
    levels: tuple[SeverityLevel, ...]
    """One for each severity, in the order of the spec."""

    @property
    def absent(self) -> int:
        """Cells that are missing, those of the Expert too."""
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


@dataclass(frozen=True)
class Verdict:
    """What the rule says of a check, and why."""

    outcome: Outcome
    reason: str

    def __str__(self) -> str:
        return f"{self.outcome}: {self.reason}"


@dataclass(frozen=True)
class _Finding:
    """What one part of the rule says."""

    outcome: Outcome
    text: str
    advice: str = ""


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
    worst = next(outcome for outcome in outcomes if any(finding.outcome == outcome for finding in findings))
    named = [finding for finding in findings if finding.outcome == worst]
    advice = dict.fromkeys(finding.advice for finding in named if finding.advice)
    return Verdict(worst, ": ".join(filter(None, ("; ".join(finding.text for finding in named), ", ".join(advice)))))


def _steps(check: SeverityCheck) -> Iterator[_Finding]:
    """What speaks against a return that falls with the severity; the step from the expert to the first one is not part of it."""
    if len(check.levels) == 1:
        yield _Finding("accepted", "only one severity; trend not tested")
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
        yield _Finding(outcome, text, _REMEDY[outcome])
    if falls:
        yield _Finding("accepted", "falls at every step")


def _loss(check: SeverityCheck) -> _Finding:
    """Whether the moderate severity loses enough of the expert's return."""
    level = check.moderate
    if level is None:
        return _Finding("accepted", f"how much it loses is not judged: {without_moderate(check)}")
    share, above = check.share(level), difference(level.returns, check.expert.returns, KEPT)
    if above is None:
        raise ValueError(f"{check.task} {check.operator}: no episode is in both {level.title} and the expert")
    if share is None:
        text = f"the expert's return is {number(check.expert.mean)}, so that no share of it is defined"
        return _Finding("undecided", text, "train the expert longer")
    keeps = f"{level.severity} keeps {100 * share:.0f} % of the expert's return"
    if above.mean <= 0:
        return _Finding("accepted", keeps)
    keeps += f", {above} above {100 * KEPT:.0f} % of it"
    if above.sure:
        return _Finding("not accepted", keeps, _REMEDY["not accepted"])
    return _Finding("undecided", f"{keeps}, which may be chance", _REMEDY["undecided"])


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
    """Return the checks of a spec, by task and then by operator, and the frame that they are made from.

    Args:
        spec: for tasks, operators and seeds, in its own order.
        wanted: its cells of Human-only and of the Expert; of other methods nothing is taken.
    """
    frame = read_frame(wanted)
    return checks_of(spec, frame), frame


def checks_of(spec: Spec, frame: Frame) -> list[SeverityCheck]:
    """Return the checks in a frame, by task and then by operator, in the order of the spec."""
    numbers = {cell.identity: cell for cell in frame.cells}

    def level(task: str, method: str, variant: str, severity: str | None, value: float | None) -> SeverityLevel:
        identities = [CellIdentity(task, method, "full", variant, value, seed) for seed in spec.seeds]
        cells = tuple(numbers[identity] for identity in identities if identity in numbers)
        returns = {place: value for cell in cells for place, value in _returns(cell).items()}
        return SeverityLevel(severity, value, returns, cells, len(identities) - len(cells))

    checks = []
    for task in spec.tasks:
        expert = level(task, "expert", UNIMPAIRED, None, None)
        for variant, severities in spec.operators.items():
            levels = (level(task, "human", variant, name, value) for name, value in severities.items())
            checks.append(SeverityCheck(task, variant, expert, tuple(levels)))
    return checks


def _returns(cell: CellNumbers) -> dict[tuple[int, int], float]:
    """Return of each episode by the seed of the cell and its index."""
    return {(cell.identity.seed, index): value for index, value in enumerate(cell.episodes["return"].tolist())}
