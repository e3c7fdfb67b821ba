"""What a report says of a paper: each printed number beside ours, and whether each claim holds.

A comparison asks for the sign of a contrast, which is taken within each training on the same worlds
(`report.bootstrap`):

    lower                      left - right + margin |right| < 0
    higher                     left - right - margin |right| > 0
    not_lower                  left - right + margin |right| >= 0
    not_higher                 left - right - margin |right| <= 0
    at_least, at_most          left - bound >= 0, left - bound <= 0

It holds when the whole interval of the contrast has that sign, does not hold when the whole
interval has the other, and is undecided when 0 is within. The interval is that of a hierarchical
bootstrap over trainings and worlds, nominally 95 %. With few trainings it is too narrow: the t
interval of the trainings' contrasts is shown beside it as a warning, and decides nothing.

A claim holds when all of its questions hold, and does not hold when one of them does not. A claim
with missing rows is not tested; the answers to its other questions are kept (`Judged.part`). With
the models of a single training a verdict is about these models, and says so.

A method can have another recipe: `printed` is WASP as the paper prints it. Claims about the method
are judged a second time with the row of that recipe in its place (`Judged.others`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from wasp_cli.cells.table import JUDGED, CellTable
from wasp_cli.methods.registry import METHODS
from wasp_cli.report.bootstrap import Contrast, Estimate, Limits, contrast_of, mean_of
from wasp_cli.report.stats import Frame, Group, row_of
from wasp_cli.report.tables import task_title
from wasp_cli.report.tables.comparison import MEANS as NECESSITY
from wasp_cli.report.tables.main import (
    AUTONOMY_COLUMNS,
    DETAIL_COLUMNS,
    MORE_COLUMNS,
    PAPER_COLUMNS,
)
from wasp_cli.spec.model import Spec
from wasp_cli.spec.paper import Claim, Comparison, Paper, Printed, Relation, Who

COLUMN_OF = {
    column.key: column
    for column in (*PAPER_COLUMNS, *MORE_COLUMNS, *AUTONOMY_COLUMNS, *DETAIL_COLUMNS, *NECESSITY)
}
"""Everything that a claim may be about (spec.paper.COLUMNS)."""
Outcome = Literal["holds", "fails", "undecided", "untested"]


@dataclass(frozen=True)
class Answer:
    """One comparison of a claim with our rows: our numbers, the contrast, and its outcome."""

    asked: Comparison
    outcome: Outcome
    left: float | None = None
    right: float | None = None  # our means
    # over the conditions that both have; the outcome is the sign of its interval
    contrast: Contrast | None = None
    reason: str = ""  # why it is not tested; empty if no row is about its task
    printed: tuple[Printed | None, Printed | None] = (None, None)
    # whether the paper's own means have this relation; None if it does not print them
    shown_in_print: bool | None = None


@dataclass(frozen=True)
class Judged:
    """A claim with its outcome and the answers to each of its questions."""

    claim: Claim
    outcome: Outcome
    answers: tuple[tuple[Answer, ...], ...]  # per question its alternatives, of which one is enough
    others: tuple[Judged | None, ...] = ()
    """The same claim with each of the report's `others` in the place of its method; None if it does
    not name the method, or names both.
    """

    @property
    def part(self) -> Outcome:
        """The outcome of those questions that could be asked; `untested` where none could."""
        outcomes = [any_of(answers) for answers in self.answers]
        return all_of([outcome for outcome in outcomes if outcome != "untested"])


@dataclass(frozen=True)
class Beside:
    """A row of one of the paper's tables, with our numbers for the same task and assistant.

    `printed` and `ours` have one entry per column, in the order of `columns`; an entry of `ours` is
    None where our rows do not define it.
    """

    table: str
    columns: tuple[str, ...]
    task: str
    who: Who
    printed: tuple[Printed, ...]
    ours: tuple[Estimate | None, ...]
    seeds: int  # behind ours
    note: str = ""  # why it is incomplete, where it is


@dataclass(frozen=True)
class VerdictReport:
    """What a report says about a paper: its numbers beside ours, and its claims with their
    outcomes.
    """

    paper: Paper
    rows: tuple[Beside, ...]  # of the tasks that are here
    claims: tuple[Judged, ...]
    seeds: int
    one_training: bool  # whether all rows come from the models of one training
    notes: tuple[str, ...]
    # other recipes of a method, by whose rows claims are judged a second time
    others: tuple[Who, ...] = ()

    def having(self, outcome: Outcome) -> list[Judged]:
        """Return the claims with this outcome, in the order of the paper file."""
        return [judged for judged in self.claims if judged.outcome == outcome]


def judge(frame: Frame, paper: Paper, spec: Spec | None = None) -> VerdictReport:
    """Judge every claim of a paper by the rows of a report.

    Args:
        frame: the cells of the report, with their branches where claims are about these.
        paper: its printed tables and its claims.
        spec: what was run; its preset and training seed are mentioned in the notes.

    Returns:
        The verdicts. A claim whose rows are missing or incomplete is `untested`.
    """
    rows = _Rows(frame)
    seeds = len(np.unique(frame.cells.seeds))

    # Other recipes of a method that have rows here, by which claims are judged again.
    recipes = [Who(name) for name, info in METHODS.items() if info.instead_of]
    others = tuple(who for who in recipes if rows.has(who))

    claims: list[Judged] = []
    for claim in paper.claims:
        by_others = tuple(_judged_by(rows, paper, claim, who) for who in others)
        claims.append(replace(_judged(rows, paper, claim), others=by_others))
    return VerdictReport(
        paper=paper,
        rows=tuple(_beside(rows, paper)),
        claims=tuple(claims),
        seeds=seeds,
        one_training=len(np.unique(frame.cells.trainings)) == 1,
        notes=tuple(_notes(frame, rows, paper, seeds, spec)),
        others=others,
    )


def decide(interval: Limits | None, relation: Relation) -> Outcome:
    """Return the outcome for the interval of a contrast: `holds` or `fails` where the whole
    interval has one sign, else `undecided`. Without an interval it is `undecided`.
    """
    if interval is None:
        return "undecided"
    low, high = interval
    # Mirrored, so that for every relation negative values speak for it.
    if relation in ("higher", "not_lower", "at_least"):
        low = -interval[1]
        high = -interval[0]
    if low > 0:
        return "fails"
    is_strict = relation in ("lower", "higher")
    if high < 0 or (high == 0 and not is_strict):
        return "holds"
    return "undecided"


def signed_margin(asked: Comparison) -> float:
    """Return the share of |right| that is subtracted from left - right; it is negative where that
    share is added.
    """
    return asked.margin if asked.relation in ("higher", "not_higher") else -asked.margin


def any_of(answers: Sequence[Answer]) -> Outcome:
    """Combine the answers of alternatives, of which one is enough: `fails` only if all of them
    fail.
    """
    outcomes = {answer.outcome for answer in answers}
    order: tuple[Outcome, ...] = ("holds", "untested", "undecided")
    for outcome in order:
        if outcome in outcomes:
            return outcome
    return "fails"


def all_of(outcomes: Sequence[Outcome]) -> Outcome:
    """Combine the outcomes of questions that all have to hold: one that fails decides, then one
    that is untested, then one that is undecided. Without any outcome the result is `untested`.
    """
    for outcome in ("fails", "untested", "undecided"):
        if outcome in outcomes:
            return outcome
    return "holds" if outcomes else "untested"


class _Rows:
    """The rows of a report by task and assistant, with each mean and contrast computed once."""

    def __init__(self, frame: Frame) -> None:
        rows = frame.groups
        self.tasks = tuple(dict.fromkeys(group.task for group in rows))
        self._groups = {(group.task, Who(group.method, group.variant)): group for group in rows}
        self._unbranched = Counter(row_of(gap.cell) for gap in frame.unbranched)
        self.mean = cache(self._mean)
        self.contrast = cache(self._contrast)

    def group(self, task: str, who: Who) -> Group | None:
        """Return the row of an assistant on a task; None where the report has none."""
        return self._groups.get((task, who))

    def has(self, who: Who) -> bool:
        """Return whether an assistant has a row on any task."""
        return any(known == who for _, known in self._groups)

    def _mean(self, task: str, who: Who, column: str) -> Estimate | None:
        group = self.group(task, who)
        if group is None:
            return None
        return mean_of(group.cells, column)

    def _contrast(self, asked: Comparison) -> Contrast | None:
        own = self.group(asked.task, asked.left)
        against: CellTable | float | None = asked.bound
        if asked.right is not None:
            other = self.group(asked.task, asked.right)
            against = None if other is None else other.cells
        if own is None or against is None:
            return None
        return contrast_of(own.cells, against, asked.column, signed_margin(asked))

    def lack(self, task: str, who: Who, column: str = "") -> str:
        """Return what a row lacks to be compared by a column, as words; empty where nothing."""
        group = self.group(task, who)
        if group is None:
            return f"{task_title(task)} has no {who}"
        total = len(group.cells) + group.absent
        if not group.complete:
            return f"{task_title(task)} {who} has {len(group.cells)} of {total} cells"
        gaps = self._unbranched[group.assistant]
        if column in JUDGED and gaps:
            return f"{task_title(task)} {who} has branches of {total - gaps} of {total} cells"
        return ""


def _judged(rows: _Rows, paper: Paper, claim: Claim) -> Judged:
    answers = tuple(
        tuple(_answer(rows, paper, asked) for asked in question) for question in claim.questions()
    )
    return Judged(claim, all_of([any_of(each) for each in answers]), answers)


def stood_for(who: Who) -> Who:
    """Return the row in whose place another recipe is judged: of `printed` that is `wasp`."""
    return Who(METHODS[who.method].instead_of)


def _judged_by(rows: _Rows, paper: Paper, claim: Claim, who: Who) -> Judged | None:
    """Judge a claim with the row of another recipe in the place of its method; None where the claim
    does not name that method, or names both.
    """
    place = stood_for(who)
    named = {
        side
        for question in claim.questions()
        for asked in question
        for side in (asked.left, asked.right)
        if side is not None
    }
    own = {side: Who(who.method, side.variant) for side in named if side.method == place.method}
    if not own or who.method in {side.method for side in named}:
        return None

    def placed(sides: tuple[Who, ...] | None) -> tuple[Who, ...] | None:
        if sides is None:
            return None
        return tuple(own.get(side, side) for side in sides)

    statements = (
        each.model_copy(update={"left": placed(each.left), "right": placed(each.right)})
        for each in claim.statements
    )
    return _judged(rows, paper, claim.model_copy(update={"statements": tuple(statements)}))


def _answer(rows: _Rows, paper: Paper, asked: Comparison) -> Answer:
    # What the paper prints of both sides.
    printed_right = None
    if asked.right is not None:
        printed_right = paper.printed(asked.task, asked.right, asked.column)
    printed = (paper.printed(asked.task, asked.left, asked.column), printed_right)
    answer = Answer(
        asked, "untested", printed=printed, shown_in_print=_shown_in_print(asked, *printed)
    )
    if asked.task not in rows.tasks:
        return answer

    # Our means.
    task = task_title(asked.task)
    left = rows.mean(asked.task, asked.left, asked.column)
    right = None
    if asked.right is not None:
        right = rows.mean(asked.task, asked.right, asked.column)
    answer = replace(
        answer,
        left=None if left is None else left.value,
        right=None if right is None else right.value,
    )

    # What is missing for a contrast: cells, then the column, then conditions in common.
    lacks = [rows.lack(asked.task, asked.left, asked.column)]
    if asked.right is not None:
        lacks.append(rows.lack(asked.task, asked.right, asked.column))
    reasons = [lack for lack in lacks if lack]
    if not reasons:
        if left is None:
            reasons.append(f"{task} {asked.left} has no `{asked.column}`")
        if asked.right is not None and right is None:
            reasons.append(f"{task} {asked.right} has no `{asked.column}`")
    contrast = None
    if not reasons:
        contrast = rows.contrast(asked)
        if contrast is None:
            reasons.append(
                f"{task} {asked.left} and {asked.right} have no operator and seed in common"
            )
    if contrast is None:
        return replace(answer, reason="; ".join(dict.fromkeys(reasons)))
    return replace(answer, outcome=decide(contrast.bootstrap, asked.relation), contrast=contrast)


def _shown_in_print(asked: Comparison, left: Printed | None, right: Printed | None) -> bool | None:
    if left is None or (right is None and asked.right is not None):
        return None
    # Shares are printed in percent, while a bound is a share.
    other = (asked.bound or 0.0) * COLUMN_OF[asked.column].scale
    if right is not None:
        other = right.mean
    # Rounded to nine digits, since 0.3 - 0.1 is not exactly 0.2 in floating point.
    contrast = round(left.mean - other - signed_margin(asked) * abs(other), 9)
    return decide((contrast, contrast), asked.relation) == "holds"


def _beside(rows: _Rows, paper: Paper) -> Iterable[Beside]:
    for table in paper.tables:
        for task, printed in table.rows.items():
            if task not in rows.tasks:
                continue
            # A table of ablations is shown only where at least one of them was run.
            ablations = {who for who in printed if who.variant != "full"}
            if ablations and not any(rows.group(task, who) for who in ablations):
                continue
            for who, numbers in printed.items():
                ours = tuple(rows.mean(task, who, column) for column in table.columns)
                group = rows.group(task, who)
                seeds = len(np.unique(group.cells.seeds)) if group else 0
                yield Beside(
                    table.name,
                    table.columns,
                    task,
                    who,
                    numbers,
                    ours,
                    seeds,
                    rows.lack(task, who) if group else "",
                )


def _notes(frame: Frame, rows: _Rows, paper: Paper, seeds: int, spec: Spec | None) -> Iterable[str]:
    tasks = dict.fromkeys(
        asked.task for claim in paper.claims for question in claim.questions() for asked in question
    )
    absent = [task_title(task) for task in tasks if task not in rows.tasks]
    if absent:
        names = absent[-1]
        if len(absent) > 1:
            names = f"{', '.join(absent[:-1])} and {absent[-1]}"
        verb = "is" if len(absent) == 1 else "are"
        them = "it" if len(absent) == 1 else "them"
        yield f"{names} {verb} not in this spec: what claims say of {them} is not tested."
    if seeds == 1:
        yield (
            "One seed: intervals resample its worlds, so every verdict is about these models. "
            "More seeds cover retraining."
        )
    elif spec is not None and spec.training_seed is not None:
        yield (
            f"All seeds share the models of training seed {spec.training_seed}, so every "
            "verdict is about these models."
        )
    elif seeds > 1:
        yield (
            f"Intervals resample the {seeds} trainings and the worlds of each. With few trainings "
            "they are too narrow: compare them with the t interval beside them, which is computed "
            "from the trainings alone."
        )
    if spec is not None and spec.preset != "paper":
        yield (
            f"Preset `{spec.preset}` has smaller models and budgets than the paper: a claim that "
            "does not hold here may hold with the paper's preset."
        )
    if frame.missing:
        are = "is" if len(frame.missing) == 1 else "are"
        yield (
            f"{len(frame.missing)} of {len(frame.order)} cells {are} missing; claims about the "
            "rows of such cells are not tested."
        )
    yield (
        "Each interval is nominally a 95 % interval, not corrected for the number of comparisons. "
        "The margins are ours: the paper states none."
    )
