"""Claims about a method are judged again with the row of another that stands for it."""

from tests.report.claims.test_verdict import against, asked, cell, frame_of, paper_with
from wasp_cli.report.claims import judge
from wasp_cli.report.claims_text import (
    second_headlines,
    verdict_html,
    verdict_markdown,
    verdict_terminal,
)
from wasp_cli.report.stats import Frame
from wasp_cli.spec.paper import Who

PRINTED = Who("printed")
STATEMENT = asked("lower")


def both(
    own: tuple[float, ...] = (10, 12, 11, 13), printed: tuple[float, ...] = (60, 61, 62, 61)
) -> Frame:
    """Both rows of WASP beside an operator with 43 to 46."""
    cells = (cell("printed", [mean - 1, mean, mean + 1], seed) for seed, mean in enumerate(printed))
    return frame_of(against(*own).cells, *cells)


def outcomes(frame: Frame, *statements: str) -> tuple[str, list[str | None]]:
    (found,) = judge(frame, paper_with(*statements)).claims
    return found.outcome, [other and other.outcome for other in found.others]


def test_the_other_row_has_a_verdict_of_its_own() -> None:
    assert judge(both(), paper_with(STATEMENT)).others == (PRINTED,)
    assert outcomes(both(), STATEMENT) == ("holds", ["fails"])
    assert outcomes(both((60, 61, 62, 61), (10, 12, 11, 13)), STATEMENT) == ("fails", ["holds"])
    assert outcomes(both((10, 12, 11, 13), (10, 80, 11, 90)), STATEMENT) == ("holds", ["undecided"])


def test_a_claim_that_names_the_further_row_is_asked_once() -> None:
    assert outcomes(both(), asked("lower", "right: [printed]")) == ("holds", [None])


def test_it_stands_on_the_right_side_too_and_against_a_bound() -> None:
    assert outcomes(both(), asked("higher", "right: [wasp]", left="human")) == ("holds", ["fails"])
    assert outcomes(both(), asked("at_most", "bound: 20")) == ("holds", ["fails"])


def test_what_says_nothing_of_the_method_is_not_asked_again() -> None:
    assert outcomes(both(), asked("at_least", "bound: 20", left="human")) == ("holds", [None])


def test_what_names_an_ablation_is_asked_of_that_of_the_further_row() -> None:
    statement = asked("higher", "right: [wasp]", left="wasp/task-only")
    ablated = [cell("wasp", [50.0, 51.0, 52.0], seed, variant="task-only") for seed in range(4)]
    assert outcomes(frame_of(both().cells, *ablated), statement) == ("holds", ["untested"])
    ablated += [cell("printed", [20.0, 21.0, 22.0], seed, variant="task-only") for seed in range(4)]
    assert outcomes(frame_of(both().cells, *ablated), statement) == ("holds", ["fails"])


def test_a_report_without_that_row_says_nothing_of_it() -> None:
    verdict = judge(against(10, 12, 11, 13), paper_with(STATEMENT))
    assert (verdict.others, verdict.claims[0].others, second_headlines(verdict)) == ((), (), [])
    assert (
        "as printed"
        not in verdict_markdown(verdict) + verdict_html(verdict) + verdict_terminal(verdict).plain
    )


def test_every_form_of_the_report_has_the_second_verdict() -> None:
    verdict = judge(both(), paper_with(STATEMENT, asked("higher", "right: [wasp]", left="human")))
    line = "Judged by WASP (as printed) in place of WASP: 1 does not hold; 1 of 1 verdicts differ."
    text, page = verdict_markdown(verdict), verdict_html(verdict)
    assert (
        "| Claim | Verdict | WASP (as printed) |\n| --- | --- | --- |\n| `claim` | holds | "
        "does not hold |\n" in text
    )
    assert line in text
    assert line in page
    assert line.rstrip(".") in verdict_terminal(verdict).plain
    assert '<span class="second">WASP (as printed): does not hold</span>' in page
