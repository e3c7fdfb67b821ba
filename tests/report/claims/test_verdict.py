"""The verdict: the rule for a comparison, what a claim makes of its comparisons, and what
stands beside the paper's numbers.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.report.invented import Grid
from tests.report.made import one_cell, renamed
from tests.spec.good import GOOD
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.read import Missing
from wasp_cli.cells.table import CellTable
from wasp_cli.report.bootstrap import Limits
from wasp_cli.report.claims import (
    Answer,
    Judged,
    Outcome,
    VerdictReport,
    all_of,
    any_of,
    decide,
    judge,
)
from wasp_cli.report.claims_text import sentence, verdict_markdown
from wasp_cli.report.stats import Frame
from wasp_cli.spec.load import load
from wasp_cli.spec.model import Spec
from wasp_cli.spec.paper import Comparison, Paper, Relation, Who, load_paper, paper_of
from wasp_cli.spec.read import parse
from wasp_cli.store.tables import CellIdentity

RELATIONS: tuple[Relation, ...] = ("lower", "higher", "not_lower", "not_higher")


def cell(
    method: str,
    numbers: Sequence[float],
    seed: int = 0,
    task: str = "goal1",
    variant: str = "full",
    **more: Any,
) -> CellTable:
    """A table of one cell with one column, `cost`, and whatever else is given."""
    identity = CellIdentity(task, method, variant, "laggy", 0.5, seed)
    worlds = np.arange(len(numbers)) + 100.0
    return one_cell(identity, worlds, None, cost=numbers, **more)


def frame_of(*cells: CellTable, missing: Sequence[Missing] = ()) -> Frame:
    table = CellTable.joined(cells)
    return Frame(table, tuple(missing), (*table.cells, *(gap.cell for gap in missing)))


def paper_with(*statements: str, says: str = "It is so.", tables: str = "[]") -> Paper:
    lines = "".join(f"      - {{{statement}}}\n" for statement in statements)
    text = (
        f"title: A paper\ntables: {tables}\nclaims:\n  - id: claim\n    section: '1'\n    "
        f"says: {says}\n    statements:\n{lines}"
    )
    return paper_of(parse(text, "paper.yaml"))


def asked(
    relation: str,
    more: str = "right: [human]",
    columns: str = "columns: [cost]",
    left: str = "wasp",
    task: str = "goal1",
) -> str:
    return f"tasks: [{task}], {columns}, left: [{left}], relation: {relation}, {more}"


def judged(frame: Frame, *statements: str) -> Judged:
    (found,) = judge(frame, paper_with(*statements)).claims
    return found


def in_the_open(limits: Limits | None, relation: Relation, threshold: float = 0.0) -> Outcome:
    """The rule, written out."""
    low, high = limits
    if relation == "lower":
        return "holds" if high < threshold else "fails" if low > threshold else "undecided"
    if relation == "higher":
        return "holds" if low > threshold else "fails" if high < threshold else "undecided"
    if relation in ("not_higher", "at_most"):
        return "holds" if high <= threshold else "fails" if low > threshold else "undecided"
    return "holds" if low >= threshold else "fails" if high < threshold else "undecided"


@pytest.mark.parametrize("relation", [*RELATIONS, "at_least", "at_most"])
def test_the_rule_for_every_place_of_an_interval(relation: Relation) -> None:
    reached = set()
    for low, high in product((-2.0, -1.0, 0.0, 1.0, 2.0), repeat=2):
        if low <= high:
            found = decide((low, high), relation)
            assert found == in_the_open((low, high), relation), (low, high)
            reached.add(found)
    assert reached == {"holds", "fails", "undecided"}
    assert decide(None, relation) == "undecided"


def test_what_a_claim_makes_of_its_comparisons() -> None:
    outcomes: tuple[Outcome, ...] = ("holds", "fails", "undecided", "untested")
    comparison = Comparison("goal1", "cost", Who("wasp"), "lower", Who("human"))
    for found in product(outcomes, repeat=3):
        answers = [Answer(comparison, outcome) for outcome in found]
        assert any_of(answers) == (
            "holds"
            if "holds" in found
            else "untested"
            if "untested" in found
            else "undecided"
            if "undecided" in found
            else "fails"
        )
        assert all_of(found) == (
            "fails"
            if "fails" in found
            else "untested"
            if "untested" in found
            else "undecided"
            if "undecided" in found
            else "holds"
        )
    assert all_of([]) == "untested"


HUMAN = [cell("human", [40.0 + seed, 44.0, 48.0], seed) for seed in range(4)]


def against(*means: float) -> Frame:
    """WASP with these mean costs, a seed each, beside an operator with 43 to 46."""
    return frame_of(
        *HUMAN[: len(means)],
        *(cell("wasp", [mean - 1, mean, mean + 1], seed) for seed, mean in enumerate(means)),
    )


@pytest.mark.parametrize(
    ("means", "statement", "outcome"),
    [
        ((10, 12, 11, 13), asked("lower"), "holds"),
        ((10, 12, 11, 13), asked("higher"), "fails"),
        ((10, 80, 11, 90), asked("lower"), "undecided"),
        ((10, 12, 11, 13), asked("lower", "right: [human], margin: 0.5"), "holds"),
        ((40, 41, 42, 41), asked("lower", "right: [human], margin: 0.5"), "fails"),
        ((46, 47, 46, 47), asked("not_higher", "right: [human], margin: 0.1"), "holds"),
        ((30, 60, 31, 62), asked("not_lower", "right: [human], margin: 0.1"), "undecided"),
        ((50, 51, 52, 53), asked("at_least", "bound: 50"), "holds"),
        ((50, 51, 52, 53), asked("at_most", "bound: 49.5"), "fails"),
        ((48, 51, 52, 53), asked("at_least", "bound: 50"), "undecided"),
        ((10, 12, 11, 13), asked("lower", "right: [ida]"), "untested"),
        ((10, 12, 11, 13), asked("lower", columns="columns: [uir]"), "untested"),
        ((10, 12, 11, 13), asked("lower", task="race1"), "untested"),
    ],
)
def test_outcomes(means: tuple[float, ...], statement: str, outcome: Outcome) -> None:
    assert judged(against(*means), statement).outcome == outcome


@pytest.mark.parametrize("relation", RELATIONS)
def test_the_margin_is_on_the_side_of_the_relation(relation: Relation) -> None:
    """Two worlds with the same numbers have an interval of no width: the sign of each contrast
    is plain arithmetic.
    """
    reached = set()
    for left, right, margin in product(
        (-8.0, -6.0, 6.0, 7.0, 8.0, 9.0, 10.0), (-8.0, 8.0), (0.125, 0.25)
    ):
        frame = frame_of(cell("human", [right] * 2), cell("wasp", [left] * 2))
        room = margin * abs(right)
        wanted = {
            "lower": left < right - room,
            "higher": left > right + room,
            "not_lower": left >= right - room,
            "not_higher": left <= right + room,
        }[relation]
        at_zero = left - right == (room if relation in ("higher", "not_higher") else -room)
        (answer,) = judged(frame, asked(relation, f"right: [human], margin: {margin}")).answers[0]
        # an interval that is 0 lies on neither side of a strict sign
        other = "undecided" if at_zero else "fails"
        assert answer.outcome == ("holds" if wanted else other), (left, right, margin)
        reached.add(answer.outcome)
    assert {"holds", "fails"} <= reached


def test_a_margin_is_taken_within_each_training() -> None:
    """Costs that differ by a factor: each training halves its cost, so that every contrast is
    below 0; the mean's margin hid that.
    """
    costs = (1.0, 20.0, 60.0)
    frame = frame_of(
        *(cell("human", [cost, cost], seed) for seed, cost in enumerate(costs)),
        *(cell("wasp", [cost / 2, cost / 2], seed) for seed, cost in enumerate(costs)),
    )
    (answer,) = judged(frame, asked("lower", "right: [human], margin: 0.25")).answers[0]
    assert answer.outcome == "holds"
    assert answer.contrast.trainings == pytest.approx([-0.25 * cost for cost in costs])
    assert answer.contrast.t[1] > 0  # three trainings show little


def test_a_contrast_shows_on_which_side_of_zero_it_lies() -> None:
    (answer,) = judged(
        frame_of(cell("human", [9.0] * 2), cell("wasp", [9.0004] * 2)), asked("lower")
    ).answers[0]
    assert answer.outcome == "fails"
    assert "; +0.0004 (+0.0004 to +0.0004), needed" in sentence(answer)


def test_what_is_not_there_is_named() -> None:
    lost = RecordedCell("goal1", "wasp", "full", "laggy", 0.7, 0)
    gap = Missing(lost, "failed", lost.title)
    reasons = {
        statement: judged(frame, statement).answers[0][0].reason
        for frame, statement in (
            (against(10, 12, 11), asked("lower", "right: [ida]")),
            (against(10, 12, 11), asked("lower", columns="columns: [uir]")),
            (frame_of(*HUMAN, cell("wasp", [1.0, 2.0]), missing=[gap]), asked("lower")),
            (frame_of(*HUMAN[:1], cell("wasp", [1.0, 2.0], seed=5)), asked("higher")),
        )
    }
    assert list(reasons.values()) == [
        "Goal1 has no ida",
        "Goal1 wasp has no `uir`; Goal1 human has no `uir`",
        "Goal1 wasp has 1 of 2 cells",
        "Goal1 wasp and human have no operator and seed in common",
    ]


def test_a_claim_about_branches_needs_those_of_all_cells() -> None:
    uir = {"wasp": [0.2, 0.3], "ida": [0.6, 0.7]}
    cells = [
        cell(method, [40.0, 44.0], seed, uir=worth, branches=[1, 1])
        for method, worth in uir.items()
        for seed in (0, 1)
    ]
    claim, whole = asked("lower", "right: [ida]", "columns: [uir]"), frame_of(*cells)
    assert judged(whole, claim).outcome == "holds"
    partly = replace(
        whole,
        unbranched=(
            Missing(cells[1].cells[0], "not computed yet", "wasp s1", kind="counterfactual"),
        ),
    )
    found = judged(partly, claim)
    assert (found.outcome, found.answers[0][0].reason) == (
        "untested",
        "Goal1 wasp has branches of 1 of 2 cells",
    )
    assert judged(partly, asked("lower", "right: [ida]")).outcome == "undecided"


def test_one_comparison_that_fails_settles_a_claim_that_is_not_tested_as_a_whole() -> None:
    frame = against(10, 12, 11)
    elsewhere = asked("lower", task="race1")
    assert judged(frame, asked("higher"), elsewhere).outcome == "fails"
    partly = judged(frame, asked("lower"), elsewhere)
    assert (partly.outcome, partly.part) == ("untested", "holds")
    assert (judged(frame, elsewhere).outcome, judged(frame, elsewhere).part) == (
        "untested",
        "untested",
    )


def test_one_of_two_columns_is_enough() -> None:
    seeds = range(3)
    cells = [cell("wasp", [1.0, 2.0], seed, mag=[5.0, 6.0]) for seed in seeds]
    cells += [cell("human", [9.0 + seed, 9.0], seed, mag=[1.0, 1.0 + seed]) for seed in seeds]
    either = judged(frame_of(*cells), asked("lower", columns="either: [cost, mag]"))
    assert [answer.outcome for answer in either.answers[0]] == ["holds", "fails"]
    assert either.outcome == "holds"
    assert (
        judged(frame_of(*cells), asked("lower", columns="columns: [cost, mag]")).outcome == "fails"
    )
    assert (
        judged(frame_of(*cells), asked("higher", columns="either: [cost, mag]")).outcome == "holds"
    )


def spec(tmp_path: Any, more: str = "") -> Spec:
    path = tmp_path / "spec.yaml"
    path.write_text(GOOD + more, encoding="utf-8")
    return load(path).spec


@pytest.mark.parametrize(
    ("seeds", "more", "words", "note"),
    [
        (1, "", "holds for these models", "One seed: intervals resample its worlds"),
        (3, "", "holds", "resample the 3 trainings and the worlds of each"),
        (4, "", "holds", "smaller models and budgets"),
        (4, "training_seed: 0\n", "holds for these models", "share the models of training seed 0"),
    ],
)
def test_a_verdict_says_what_it_is_about(
    seeds: int, more: str, words: str, note: str, tmp_path: Any
) -> None:
    frame = against(*(10.0 + seed for seed in range(seeds)))
    if more:
        frame = frame_of(renamed(frame.cells, lambda _: {"training_seed": 0}))
    verdict = judge(frame, paper_with(asked("lower")), spec(tmp_path, more))
    text = verdict_markdown(verdict)
    assert f"- **{words}**: It is so. (`claim`, section 1)" in text
    assert any(note in each for each in verdict.notes)
    assert all(each in text for each in verdict.notes)
    assert ("; t " in text) == (words == "holds")


@pytest.mark.parametrize(
    ("column", "bound", "shown"),
    [("success", 0.7, False), ("success", 0.6, True), ("return", 60.0, True)],
)
def test_percent_in_print_is_held_against_a_bound_that_is_a_share(
    column: str, bound: float, shown: bool
) -> None:
    tables = f"[{{name: Table 1, columns: [{column}], rows: {{goal1: {{wasp: [62]}}}}}}]"
    paper = paper_with(asked("at_least", f"bound: {bound}", f"columns: [{column}]"), tables=tables)
    ((answer,),) = judge(frame_of(cell("wasp", [1.0, 2.0])), paper).claims[0].answers
    assert answer.shown_in_print is shown


# The verdict as tables, text and HTML: the paper that is shipped, over a grid of invented cells.


@pytest.fixture(scope="module")
def verdict(frame: Frame) -> VerdictReport:
    return judge(frame, load_paper())


def test_a_missing_cell_leaves_its_claims_untested(grid: Callable[..., Grid]) -> None:
    made = grid()
    first = next(place for place, one in enumerate(made.cells) if one.method == "wasp")
    made.rows(first).unlink()
    verdict = judge(made.read(), load_paper())
    answers = [
        answer
        for found in verdict.claims
        for each in found.answers
        for answer in each
        if answer.asked.task == "goal1"
    ]
    about = [
        answer
        for answer in answers
        if "wasp" in {side.method for side in (answer.asked.left, answer.asked.right) if side}
    ]
    assert {answer.outcome for answer in about} == {"untested"}
    assert {answer.outcome for answer in answers if answer not in about} <= {
        "holds",
        "fails",
        "undecided",
    }
    assert (
        "1 of 63 cells is missing; claims about the rows of such cells are not tested."
        in " ".join(verdict.notes)
    )
    assert "Not tested: Goal1 wasp has 11 of 12 cells." in verdict_markdown(verdict)
