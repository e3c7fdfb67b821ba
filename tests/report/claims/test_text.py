"""The verdict as tables, text and HTML: the paper that is shipped, over a grid of invented cells."""

from collections.abc import Callable

import pytest

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
