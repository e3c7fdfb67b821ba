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
bootstrap over trainings and worlds, nominally 95 %. Of few trainings it is too narrow: the t
interval of the trainings' contrasts stands beside it as a warning, and decides nothing.

A claim holds when all of its questions do, and does not hold when one does not. One whose rows are
not all there is not tested; what the others say is kept beside it. With the models of a single
training a verdict is about these models, and says so.

Another method may stand for a method, as the printed WASP does for WASP. Claims are judged again
with its row in the method's place. Claims that name an ablation are not.
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
    asked: Comparison
    outcome: Outcome
    left: float | None = None
    right: float | None = None  # our means
    # over the conditions that both have; its interval is held against 0
    contrast: Contrast | None = None
    reason: str = ""  # why it is not tested; empty where its task is not here at all
    printed: tuple[Printed | None, Printed | None] = (None, None)
    # whether the paper's own means stand so; None where it prints none
    shown_in_print: bool | None = None


@dataclass(frozen=True)
class Judged:
    claim: Claim
    outcome: Outcome
    answers: tuple[tuple[Answer, ...], ...]  # per question; of the answers in a tuple one is enough
    others: tuple[Judged | None, ...] = ()
    """The same claim with each of the report's `others` in its method's place; None where that
    cannot be asked.
    """

    @property
    def part(self) -> Outcome:
        """The outcome of those questions that could be asked; `untested` where none could."""
        return all_of(
            [outcome for answers in self.answers if (outcome := any_of(answers)) != "untested"]
        )


@dataclass(frozen=True)
class Beside:
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
    paper: Paper
    rows: tuple[Beside, ...]  # of the tasks that are here
    claims: tuple[Judged, ...]
    seeds: int
    one_training: bool  # whether all rows come from the models of one training
    notes: tuple[str, ...]
    # the rows that stand for a method as another recipe makes it, and that claims are judged by too
    others: tuple[Who, ...] = ()

    def having(self, outcome: Outcome) -> list[Judged]:
        return [judged for judged in self.claims if judged.outcome == outcome]


def judge(frame: Frame, paper: Paper, spec: Spec | None = None) -> VerdictReport:
    rows = _Rows(frame)
    seeds = len(np.unique(frame.cells.seeds))
    others = tuple(
        filter(rows.has, (Who(name) for name, info in METHODS.items() if info.instead_of))
    )
    judged = (_judged(rows, paper, claim) for claim in paper.claims)
    return VerdictReport(
        paper=paper,
        rows=tuple(_beside(rows, paper)),
        claims=tuple(
            replace(own, others=tuple(_judged_by(rows, paper, own.claim, who) for who in others))
            for own in judged
        ),
        seeds=seeds,
        one_training=len(np.unique(frame.cells.trainings)) == 1,
        notes=tuple(_notes(frame, rows, paper, seeds, spec)),
        others=others,
    )


def decide(interval: Limits | None, relation: Relation) -> Outcome:
    """Apply the rule to the interval of a contrast; undecided without an interval."""
    if interval is None:
        return "undecided"
    low, high = interval
    if relation in ("higher", "not_lower", "at_least"):
        low, high = -high, -low
    if low > 0:
        return "fails"
    beyond = high < 0 if relation in ("lower", "higher") else high <= 0
    return "holds" if beyond else "undecided"


def signed_margin(asked: Comparison) -> float:
    """Return the share of |right| that a contrast takes off left - right; negative where it
    puts it on.
    """
    return asked.margin if asked.relation in ("higher", "not_higher") else -asked.margin


def any_of(answers: Sequence[Answer]) -> Outcome:
    """Combine alternatives: one is enough, and none of them holds only when each was tested."""
    outcomes = {answer.outcome for answer in answers}
    return next(
        (outcome for outcome in ("holds", "untested", "undecided") if outcome in outcomes), "fails"
    )


def all_of(outcomes: Sequence[Outcome]) -> Outcome:
    """Combine questions: one that does not hold settles it; otherwise all have to be tested,
    and all have to hold.
    """
    for outcome in ("fails", "untested", "undecided"):
        if outcome in outcomes:
            return outcome
    return "holds" if outcomes else "untested"


class _Rows:
    def __init__(self, frame: Frame) -> None:
        rows = frame.groups
        self.tasks = tuple(dict.fromkeys(group.task for group in rows))
        self._groups = {(group.task, Who(group.method, group.variant)): group for group in rows}
        self._unbranched = Counter(row_of(gap.cell) for gap in frame.unbranched)
        self.mean, self.contrast = cache(self._mean), cache(self._contrast)

    def group(self, task: str, who: Who) -> Group | None:
        return self._groups.get((task, who))

    def has(self, who: Who) -> bool:
        return any(known == who for _, known in self._groups)

    def _mean(self, task: str, who: Who, column: str) -> Estimate | None:
        group = self.group(task, who)
        return None if group is None else mean_of(group.cells, column)

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
        group = self.group(task, who)
        if group is None:
            return f"{task_title(task)} has no {who}"
        total = len(group.cells) + group.absent
        if not group.complete:
            return f"{task_title(task)} {who} has {len(group.cells)} of {total} cells"
        gaps = self._unbranched[group.assistant] if column in JUDGED else 0
        return (
            f"{task_title(task)} {who} has branches of {total - gaps} of {total} cells"
            if gaps
            else ""
        )


def _judged(rows: _Rows, paper: Paper, claim: Claim) -> Judged:
    answers = tuple(
        tuple(_answer(rows, paper, asked) for asked in question) for question in claim.questions()
    )
    return Judged(claim, all_of([any_of(each) for each in answers]), answers)


def stood_for(who: Who) -> Who:
    return Who(METHODS[who.method].instead_of)


def _judged_by(rows: _Rows, paper: Paper, claim: Claim, who: Who) -> Judged | None:
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
    printed_right = None
    if asked.right is not None:
        printed_right = paper.printed(asked.task, asked.right, asked.column)
    printed = (paper.printed(asked.task, asked.left, asked.column), printed_right)
    answer = Answer(
        asked, "untested", printed=printed, shown_in_print=_shown_in_print(asked, *printed)
    )
    if asked.task not in rows.tasks:
        return answer
    sides = [who for who in (asked.left, asked.right) if who is not None]
    lacks = [rows.lack(asked.task, who, asked.column) for who in sides]
    lacking = [lack for lack in lacks if lack]
    means = [rows.mean(asked.task, who, asked.column) for who in sides]
    if not lacking:
        pairs = zip(means, sides, strict=True)
        lacking = [
            f"{task_title(asked.task)} {who} has no `{asked.column}`"
            for mean, who in pairs
            if mean is None
        ]
    left = means[0]
    right = None if asked.right is None else means[1]
    contrast = None if lacking else rows.contrast(asked)
    if not lacking and contrast is None:
        lacking = [
            f"{task_title(asked.task)} {asked.left} and {asked.right} have no operator and "
            "seed in common"
        ]
    answer = replace(
        answer, left=left.value if left else None, right=right.value if right else None
    )
    if contrast is None:
        return replace(answer, reason="; ".join(dict.fromkeys(lacking)))
    return replace(answer, outcome=decide(contrast.bootstrap, asked.relation), contrast=contrast)


def _shown_in_print(asked: Comparison, left: Printed | None, right: Printed | None) -> bool | None:
    if left is None or (right is None and asked.right is not None):
        return None
    # To nine digits: 0.3 - 0.1 is not 0.2 to a computer. Shares are printed in percent, and a bound
    # is none.
    other = (
        right.mean if right is not None else (asked.bound or 0.0) * COLUMN_OF[asked.column].scale
    )
    contrast = round(left.mean - other - signed_margin(asked) * abs(other), 9)
    return decide((contrast, contrast), asked.relation) == "holds"


def _beside(rows: _Rows, paper: Paper) -> Iterable[Beside]:
    for table in paper.tables:
        for task, printed in table.rows.items():
            ablations = {who for who in printed if who.variant != "full"}
            if task not in rows.tasks or (
                ablations and not any(rows.group(task, who) for who in ablations)
            ):
                continue  # a table of ablations is about these
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
        which = (
            "is not in this spec: what claims say of it"
            if len(absent) == 1
            else "are not in this spec: what claims say of them"
        )
        named = " and ".join(filter(None, (", ".join(absent[:-1]), absent[-1])))
        yield f"{named} {which} is not tested."
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
            f"Intervals resample the {seeds} trainings and the worlds of each. Of few "
            "trainings they are too narrow: the t interval beside "
            "them says how little the trainings alone show."
        )
    if spec is not None and spec.preset != "paper":
        yield (
            f"Preset `{spec.preset}` has smaller models and budgets than the paper: what does "
            "not hold here may hold there."
        )
    if frame.missing:
        are = "is" if len(frame.missing) == 1 else "are"
        yield (
            f"{len(frame.missing)} of {len(frame.order)} cells {are} missing; claims about the "
            "rows of such cells are not tested."
        )
    yield (
        "Each interval is nominally of 95 %, uncorrected for the number of comparisons. The "
        "margins are ours: the paper states none."
    )
