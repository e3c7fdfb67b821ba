"""The claims of a paper as a fragment of HTML.

Classes: the section is `verdict`; a claim is a `details` of class `claim` with `holds`, `fails` or `undecided`, and `part` where only some
of its rows are here; each row of its table of comparisons has its own outcome. `data-value` has what a cell prints without rounding.
"""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

from wasp_cli.plan.reasons import few
from wasp_cli.report.claims.table import COLUMN_OF, title_of
from wasp_cli.report.claims.text import PLAIN, TITLE, beyond_print, headline, interval_text, label, lacking, needed, printed, untested
from wasp_cli.report.claims.verdict import Answer, Judged, VerdictReport, any_of
from wasp_cli.report.render.text import plain
from wasp_cli.report.tables.titles import task_title

HEADINGS = ("Task", "Measure", "Left", "Right", "Difference (95 %)", "Needed", "Outcome", "In the paper")


def verdict_html(verdict: VerdictReport) -> str:
    """Every claim with every comparison; those of which nothing could be asked in one line."""
    return "\n".join(_lines(verdict)) + "\n"


def _lines(verdict: VerdictReport) -> Iterator[str]:
    yield '<section class="verdict">'
    yield f"<h2>{escape(TITLE)}</h2>"
    yield f'<p class="headline"><cite>{escape(verdict.paper.title)}</cite>. {escape(headline(verdict))}</p>'
    yield '<ul class="notes">'
    yield from (f"<li>{escape(note)}</li>" for note in verdict.notes)
    yield "</ul>"
    for judged in verdict.claims:
        if judged.part != "untested":
            yield from _claim(verdict, judged)
    if text := untested(verdict):
        yield f'<p class="untested">{escape(text)}</p>'
    yield "</section>"


def _claim(verdict: VerdictReport, judged: Judged) -> Iterator[str]:
    claim = judged.claim
    shade = judged.outcome if judged.outcome != "untested" else f"{judged.part} part"
    yield f'<details class="claim {shade}" id="claim-{escape(claim.id)}">'
    yield (
        f'<summary><span class="outcome">{escape(label(verdict, judged))}</span> <span class="says">{escape(claim.says)}</span> '
        f'<span class="section">({escape(claim.section)})</span></summary>'
    )
    for name, text in (("reading", claim.reading), ("beyond", beyond_print(judged)), ("lacking", few(lacking([judged])))):
        if text:
            mark = {"reading": "Read as: ", "lacking": "Not tested: "}.get(name, "")
            yield f'<p class="{name}">{mark}{escape(text)}</p>'
    yield '<div class="wide"><table class="comparisons">'
    yield f"<thead><tr>{''.join(f'<th>{heading}</th>' for heading in HEADINGS)}</tr></thead><tbody>"
    for answers in judged.answers:
        for number, answer in enumerate(answers):
            if answer.outcome != "untested":
                yield _row(answer, alternative=number > 0, decided=any_of(answers) == answer.outcome)
    yield "</tbody></table></div></details>"


def _row(answer: Answer, alternative: bool, decided: bool) -> str:
    asked, column = answer.asked, COLUMN_OF[answer.asked.column]
    right = "" if asked.right is None else f"{title_of(asked.right)} {column.number(answer.right)}"
    found = answer.estimate.value if answer.estimate else None
    cells = [
        _cell(("or " if alternative else "") + task_title(asked.task)),
        _cell(column.title),
        _cell(f"{title_of(asked.left)} {column.number(answer.left)}", answer.left),
        _cell(right, answer.right),
        _cell(f"{column.number(found, asked.right is not None)}{interval_text(answer)}", found),
        _cell(needed(answer), answer.threshold),
        _cell(PLAIN[answer.outcome]),
        _cell(printed(answer)),
    ]
    return f'<tr class="{answer.outcome}{"" if decided else " aside"}">{"".join(cells)}</tr>'


def _cell(text: str, value: float | None = None) -> str:
    return f"<td>{escape(text)}</td>" if value is None else f'<td data-value="{plain(value)}">{escape(text)}</td>'
