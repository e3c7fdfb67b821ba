"""The claims of a paper as a fragment of HTML (`page/templates/claims.html`)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from wasp_cli.plan.reasons import few
from wasp_cli.report.claims.table import COLUMN_OF, title_of
from wasp_cli.report.claims.text import PLAIN, TITLE, beyond_print, headline, interval_text, label, lacking, needed, printed, untested
from wasp_cli.report.claims.verdict import Answer, Judged, VerdictReport, any_of
from wasp_cli.report.render.html import rendered
from wasp_cli.report.tables.titles import task_title

if TYPE_CHECKING:
    from markupsafe import Markup

HEADINGS = ("Task", "Measure", "Left", "Right", "Difference (95 %)", "Needed", "Outcome", "In the paper")
Cell = tuple[str, float | None]
"""A text, and the number that it prints without rounding."""


def verdict_html(verdict: VerdictReport) -> Markup:
    """Return every claim with every comparison; those of which nothing could be asked in one line."""
    claims = [_claim(verdict, judged) for judged in verdict.claims if judged.part != "untested"]
    told = {"title": TITLE, "headline": headline(verdict), "untested": untested(verdict)}
    return rendered("claims.html", verdict=verdict, headings=HEADINGS, claims=claims, **told)


def _claim(verdict: VerdictReport, judged: Judged) -> dict[str, Any]:
    claim, absent = judged.claim, few(lacking([judged]))
    remarks = (
        ("reading", claim.reading and f"Read as: {claim.reading}"),
        ("beyond", beyond_print(judged)),
        ("lacking", absent and f"Not tested: {absent}"),
    )
    shade = judged.outcome if judged.outcome != "untested" else f"{judged.part} part"
    found = {"id": claim.id, "shade": shade, "label": label(verdict, judged), "says": claim.says, "section": claim.section}
    return {**found, "remarks": remarks, "rows": list(_rows(judged))}


def _rows(judged: Judged) -> Iterator[tuple[str, list[Cell]]]:
    """Yield the class and the cells of every comparison that was asked."""
    for answers in judged.answers:
        for number, answer in enumerate(answers):
            if answer.outcome != "untested":
                aside = "" if any_of(answers) == answer.outcome else " aside"
                yield answer.outcome + aside, _cells(answer, "or " if number else "")


def _cells(answer: Answer, before: str) -> list[Cell]:
    asked, column = answer.asked, COLUMN_OF[answer.asked.column]
    found = answer.estimate.value if answer.estimate else None
    return [
        (before + task_title(asked.task), None),
        (column.title, None),
        (f"{title_of(asked.left)} {column.number(answer.left)}", answer.left),
        ("" if asked.right is None else f"{title_of(asked.right)} {column.number(answer.right)}", answer.right),
        (f"{column.number(found, asked.right is not None)}{interval_text(answer)}", found),
        (needed(answer), answer.threshold),
        (PLAIN[answer.outcome], None),
        (printed(answer), None),
    ]
