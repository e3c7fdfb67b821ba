"""The verdict as tables, text and HTML: the paper that is shipped, over a grid of invented cells."""

from __future__ import annotations

from collections.abc import Callable
from html.parser import HTMLParser

import pytest

from tests.report.claims.test_verdict import against, asked, cell, frame_of, paper_with
from wasp_cli.report.bootstrap import mean_of
from wasp_cli.report.claims import VerdictReport, judge
from wasp_cli.report.claims_text import COLUMN_OF, headline, numbers_table, verdict_html, verdict_markdown, verdict_terminal
from wasp_cli.report.render import csv_text
from wasp_cli.report.stats import Frame, Wanted, read_frame
from wasp_cli.spec.paper import COLUMNS, load_paper


@pytest.fixture(scope="module")
def verdict(frame: Frame) -> VerdictReport:
    return judge(frame, load_paper())


def test_each_number_beside_ours(verdict: VerdictReport, frame: Frame) -> None:
    table = numbers_table(verdict)
    assert [row.labels for row in table.rows] == [
        ("Table 1", "Goal1", title) for title in ("Human-only", "IDA", "Diffusion", "SafeRL-Res", "WASP")
    ]
    keys = [column.key for column in table.columns]
    assert keys == [f"{name}{end}" for name in ("return", "success", "cost", "viol", "int_rate", "mag") for end in ("_paper", "")]
    own = [one for one in frame.cells if (one.identity.method, one.identity.variant) == ("wasp", "full")]
    shown = dict(zip(keys, table.rows[-1].values, strict=True))
    estimate = mean_of(own, "success")
    assert (shown["success_paper"].mean, shown["success_paper"].sd) == pytest.approx((0.567, 0.068))
    assert (shown["success"].mean, shown["success"].delta) == pytest.approx((estimate.value, estimate.value - 0.567))
    assert table.notes == ("15 of the paper's rows are of tasks or ablations that this spec does not run.",)
    assert not table.marks
    assert "success_paper,success_paper_sd,success" in csv_text(table).splitlines()[0]


def test_rows_that_are_not_here_are_undefined_and_tables_of_ablations_need_one() -> None:
    seeds = range(3)
    cells = [cell("wasp", [1.0 + seed, 2.0], seed, task="formula1") for seed in seeds]
    table = numbers_table(judge(frame_of(*cells), load_paper()))
    assert {row.labels[0] for row in table.rows} == {"Table 1"}
    assert [row.labels[2] for row in table.rows if row.values[5].mean is not None] == ["WASP"]
    cells += [cell("wasp", [3.0 + seed, 2.0], seed, task="formula1", variant="no-case2") for seed in seeds]
    table = numbers_table(judge(frame_of(*cells), load_paper()))
    assert [row.labels[2] for row in table.rows if row.labels[0] == "Table 2"] == [
        "WASP", "WASP, safety gate only", "WASP, task gate only", "WASP, no Case II recovery", "WASP, no rollouts (H = 1)",
    ]  # fmt: skip
    assert numbers_table(judge(frame_of(cell("wasp", [1.0, 2.0], task="goal2")), load_paper())) is None


def test_claims_of_other_tasks_are_one_line(verdict: VerdictReport) -> None:
    text = verdict_markdown(verdict)
    whole = [found.claim for found in verdict.claims if found.part == "untested"]
    assert "ida-between" in [claim.id for claim in whole]
    (line,) = [line for line in text.splitlines() if line.startswith(f"{len(whole)} claims are not tested by this spec")]
    assert all(claim.says[:50] in line and claim.id not in line for claim in whole)
    assert whole[0].says[:50] in verdict_html(verdict)
    assert "- Race1 and FormulaOne1 are not in this spec: what claims say of them is not tested." in text


def test_every_tested_comparison_is_in_the_files(verdict: VerdictReport) -> None:
    text, page = verdict_markdown(verdict), verdict_html(verdict)
    tested = [answer for found in verdict.claims for answers in found.answers for answer in answers if answer.outcome != "untested"]
    assert len(tested) > 30
    assert text.count(", needed: ") == len(tested) == page.count(", needed: ")
    assert "The paper's own means do not show it: Goal1 Int. 0.25 and 0.23, Goal1 Mag. 0.25 and 0.25." in text


def test_a_terminal_counts_the_claims_in_one_line(verdict: VerdictReport) -> None:
    text = verdict_terminal(verdict).plain
    assert headline(verdict).partition(" ")[2].rstrip(".") in text
    assert "report.html" in text
    assert "\n" not in text
    assert not any(found.claim.says in text for found in verdict.claims)


class Balanced(HTMLParser):
    """Every tag is closed, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.mark.parametrize("make", [lambda verdict: verdict, lambda _: judge(against(10, 12), paper_with(asked("lower"), says=HOSTILE))])
def test_html_is_closed_and_escaped(make: Callable[[VerdictReport], VerdictReport], verdict: VerdictReport) -> None:
    page = verdict_html(make(verdict))
    parser = Balanced()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    assert "script" not in parser.tags


HOSTILE = "'</span><script>alert(1)</script> & \"x\"'"


def test_every_column_of_a_claim_has_a_title() -> None:
    assert set(COLUMNS) <= set(COLUMN_OF)


def test_a_missing_cell_leaves_its_claims_untested(grid: Callable[..., list[Wanted]]) -> None:
    wanted = grid()
    first = next(one for one in wanted if one.identity.method == "wasp")
    first.path.unlink()
    verdict = judge(read_frame(wanted), load_paper())
    answers = [answer for found in verdict.claims for each in found.answers for answer in each if answer.asked.task == "goal1"]
    about = [answer for answer in answers if "wasp" in {side.method for side in (answer.asked.left, answer.asked.right) if side}]
    assert {answer.outcome for answer in about} == {"untested"}
    assert {answer.outcome for answer in answers if answer not in about} <= {"holds", "fails", "undecided"}
    assert "1 of 63 cells is missing; claims about the rows of such cells are not tested." in " ".join(verdict.notes)
    assert "Not tested: Goal1 wasp has 11 of 12 cells." in verdict_markdown(verdict)
