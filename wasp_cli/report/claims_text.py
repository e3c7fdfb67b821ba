"""The claims of a paper in words, for the terminal, Markdown and HTML
(`page/templates/claims.html`), and its numbers as a table.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from textwrap import shorten
from typing import TYPE_CHECKING

from rich.text import Text

from wasp_cli.plan.reasons import few
from wasp_cli.report.bootstrap import Limits
from wasp_cli.report.claims import (
    COLUMN_OF,
    Answer,
    Beside,
    Judged,
    Outcome,
    VerdictReport,
    signed_margin,
    stood_for,
)
from wasp_cli.report.render import markdown_row, rendered
from wasp_cli.report.summary import UNDEFINED, Value
from wasp_cli.report.tables import Row, Table, task_title, who_title

if TYPE_CHECKING:
    from markupsafe import Markup

TITLE = "The paper's claims"
PLAIN: dict[Outcome, str] = {
    "holds": "holds",
    "fails": "does not hold",
    "undecided": "undecided",
    "untested": "not tested",
}
SIDES = {
    "lower": "below",
    "not_higher": "at most",
    "at_most": "at most",
    "higher": "above",
    "not_lower": "at least",
    "at_least": "at least",
}
SAID = 70  # characters that are shown of an untested claim


def label(verdict: VerdictReport, judged: Judged) -> str:
    """Return the verdict of a claim in a few words, such as `holds` or `in part: undecided with 3
    seeds`.
    """
    if judged.outcome != "untested" or judged.part == "untested":
        return PLAIN[judged.outcome] + _about(verdict, judged.outcome)
    return f"in part: {PLAIN[judged.part]}{_about(verdict, judged.part)}"


def headline(verdict: VerdictReport) -> str:
    """Return one sentence that counts the claims of each outcome."""
    # Claims whose questions are all tested, or one of which fails.
    parts = []
    outcomes = Counter(judged.outcome for judged in verdict.claims)
    decided: tuple[Outcome, ...] = ("holds", "fails", "undecided")
    for outcome in decided:
        if outcomes[outcome]:
            parts.append(_counted(outcomes[outcome], outcome, verdict))

    # Claims of which some questions are tested, then those of which none is.
    partial = Counter(judged.part for judged in verdict.having("untested"))
    in_part = []
    open_outcomes: tuple[Outcome, ...] = ("holds", "undecided")
    for outcome in open_outcomes:
        if partial[outcome]:
            in_part.append(_counted(partial[outcome], outcome, verdict))
    if in_part:
        tested = partial["holds"] + partial["undecided"]
        verb = "is" if tested == 1 else "are"
        parts.append(f"{tested} {verb} tested in part ({', '.join(in_part)})")
    if partial["untested"]:
        parts.append(_counted(partial["untested"], "untested", verdict))
    return f"Of {_several(len(verdict.claims), 'claim')} {'; '.join(parts)}."


def second_headlines(verdict: VerdictReport) -> list[str]:
    """Return a sentence for each other recipe by which claims were judged: how many of each
    outcome, and how many verdicts differ from those of the method itself. Recipes without a tested
    claim have none.
    """
    sentences = []
    for i, who in enumerate(verdict.others):
        pairs: list[tuple[Outcome, Outcome]] = []
        for one in verdict.claims:
            other = one.others[i]
            if other is not None and other.outcome != "untested":
                pairs.append((one.outcome, other.outcome))
        if not pairs:
            continue
        counts = Counter(outcome for _, outcome in pairs)
        parts = []
        decided: tuple[Outcome, ...] = ("holds", "fails", "undecided")
        for outcome in decided:
            if counts[outcome]:
                parts.append(_counted(counts[outcome], outcome, verdict))
        changed = sum(own != other for own, other in pairs)
        place = f"{who_title(*who)} in place of {who_title(*stood_for(who))}"
        sentences.append(
            f"Judged by {place}: {'; '.join(parts)}; {changed} of {len(pairs)} verdicts differ."
        )
    return sentences


def _second_label(verdict: VerdictReport, judged: Judged, i: int) -> str:
    other = judged.others[i]
    return "" if other is None or other.part == "untested" else label(verdict, other)


def _counted(number: int, outcome: Outcome, verdict: VerdictReport) -> str:
    singular, plural = {
        "holds": ("holds", "hold"),
        "fails": ("does not hold", "do not hold"),
        "undecided": ("is undecided", "are undecided"),
        "untested": ("is not tested", "are not tested"),
    }[outcome]
    return f"{number} {singular if number == 1 else plural}{_about(verdict, outcome)}"


def _several(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _about(verdict: VerdictReport, outcome: Outcome) -> str:
    if outcome == "undecided":
        return f" with {_several(verdict.seeds, 'seed')}"
    if verdict.one_training and outcome in ("holds", "fails"):
        return " for these models"
    return ""


def untested(verdict: VerdictReport) -> str:
    """Return one sentence that names the claims without a tested question and what is missing for
    them; empty if there are none.
    """
    untested = [judged for judged in verdict.claims if judged.outcome == judged.part == "untested"]
    if not untested:
        return ""
    reasons = few(_lacking(untested))
    what = "1 claim is" if len(untested) == 1 else f"{len(untested)} claims are"
    claims = "; ".join(
        f'"{shorten(judged.claim.says, SAID, placeholder=" ...")}"' for judged in untested
    )
    return f"{what} not tested by this spec{f' ({reasons})' if reasons else ''}: {claims}."


def _lacking(claims: Sequence[Judged]) -> list[str]:
    return list(
        dict.fromkeys(
            answer.reason
            for judged in claims
            for answers in judged.answers
            for answer in answers
            if answer.reason
        )
    )


def sentence(answer: Answer) -> str:
    """Return a comparison in words: both means, the contrast with its intervals, and what the claim
    needs. Of answers that were tested.
    """
    asked = answer.asked
    column = COLUMN_OF[asked.column]
    quantity = f"{task_title(asked.task)} {column.title}"
    sides = [f"{who_title(*asked.left)} {column.number(answer.left)}"]
    if asked.right is not None:
        sides.append(f"{who_title(*asked.right)} {column.number(answer.right)}")
    contrast = ""
    if answer.contrast is not None:
        interval = _limits(answer, answer.contrast.bootstrap) or "no interval"
        contrast = f"{_signed(answer, answer.contrast.value)} ({interval})"
        t_interval = _limits(answer, answer.contrast.t)
        if t_interval:
            contrast += f"; t {t_interval}"
    return f"{quantity}: {', '.join(sides)}; {contrast}, needed: {needed(answer)}"


def _limits(answer: Answer, limits: Limits | None) -> str:
    if limits is None:
        return ""
    return " to ".join(_signed(answer, limit) for limit in limits)


def _signed(answer: Answer, value: float) -> str:
    # A value that rounds to 0 gets one significant digit: "+0.00" would hide its sign.
    column = COLUMN_OF[answer.asked.column]
    if value and not round(value * column.scale, column.digits):
        return f"{value * column.scale:+.1g}"
    return column.number(value, True)


def needed(answer: Answer) -> str:
    """Return the inequality that a claim needs, such as `left - right + 0.1 |right| below 0`."""
    asked = answer.asked
    other = "right"
    if asked.bound is not None:
        other = COLUMN_OF[asked.column].number(asked.bound)
    margin = ""
    if asked.margin:
        sign = "+" if signed_margin(asked) < 0 else "-"
        margin = f" {sign} {asked.margin:g} |right|"
    return f"left - {other}{margin} {SIDES[asked.relation]} 0"


def printed(answer: Answer) -> str:
    """Return the means that the paper prints for both sides; empty if it does not print them."""
    if answer.shown_in_print is None:
        return ""
    return " and ".join(f"{number.mean:g}" for number in answer.printed if number is not None)


def beyond_print(judged: Judged) -> str:
    """Return a sentence that names the comparisons of a claim which the paper's own printed means
    do not show; empty if there are none.
    """
    names = []
    for answers in judged.answers:
        if all(one.shown_in_print is False for one in answers):
            for one in answers:
                title = COLUMN_OF[one.asked.column].title
                names.append(f"{task_title(one.asked.task)} {title} {printed(one)}")
    if not names:
        return ""
    return f"The paper's own means do not show it: {few(names)}."


def verdict_terminal(verdict: VerdictReport) -> Text:
    """Return one line that counts the claims by outcome; the written report lists each of them."""
    line = " ".join((headline(verdict), *second_headlines(verdict)))
    return Text.assemble(
        (f"{TITLE}: ", "bold"), f"{line[0].lower()}{line[1:-1]}; report.html lists them."
    )


def verdict_markdown(verdict: VerdictReport) -> str:
    """Return the section on the paper's claims as Markdown: the counts, the notes, a table of
    verdicts by other recipes, and each tested claim with its comparisons.
    """
    lines = [
        f"## {TITLE}",
        "",
        f"*{verdict.paper.title}*. {headline(verdict)}",
        "",
        *(f"- {note}" for note in verdict.notes),
        "",
    ]
    # The verdicts by other recipes, as a table.
    seconds_told = second_headlines(verdict)
    if seconds_told:
        titles = [who_title(*who) for who in verdict.others]
        lines += [
            *seconds_told,
            "",
            markdown_row(("Claim", "Verdict", *titles)),
            markdown_row(["---"] * (2 + len(titles))),
        ]
        for judged in verdict.claims:
            if judged.part != "untested":
                seconds = [_second_label(verdict, judged, i) for i in range(len(titles))]
                lines.append(
                    markdown_row((f"`{judged.claim.id}`", label(verdict, judged), *seconds))
                )
        lines.append("")

    # Each tested claim, then those that were not tested.
    for judged in verdict.claims:
        if judged.outcome != "untested" or judged.part != "untested":
            claim = judged.claim
            lines.append(
                f"- **{label(verdict, judged)}**: {claim.says} (`{claim.id}`, section "
                f"{claim.section})"
            )
            lines += [f"  - {text}" for text in _details(judged)]
    rest = untested(verdict)
    if rest:
        lines += ["", rest]
    return "\n".join(lines) + "\n"


def _details(judged: Judged) -> Iterator[str]:
    """Yield how a claim is read, its comparisons, what is missing, and what the paper's own means
    do not show; a line each.
    """
    if judged.claim.reading:
        yield f"Read as: {judged.claim.reading}"
    for answers in judged.answers:
        alternatives = [_compared(answer) for answer in answers if answer.outcome != "untested"]
        if alternatives:
            prefix = "one is enough: " if len(answers) > 1 else ""
            yield prefix + "; or ".join(alternatives)
    reasons = _lacking([judged])
    if reasons:
        yield f"Not tested: {few(reasons)}."
    not_in_print = beyond_print(judged)
    if not_in_print:
        yield not_in_print


def _compared(answer: Answer) -> str:
    """A comparison with its outcome, and the paper's numbers where it prints them."""
    text = f"{sentence(answer)}: {PLAIN[answer.outcome]}"
    theirs = printed(answer)
    if theirs:
        text += f" (paper: {theirs})"
    return text


def verdict_html(verdict: VerdictReport) -> Markup:
    """Return the same section as HTML, filled into `page/templates/claims.html`."""
    claims = []
    for judged in verdict.claims:
        if judged.part != "untested":
            shade: str = judged.outcome
            if judged.outcome == "untested":
                shade = f"{judged.part} part"
            seconds = []
            for i, who in enumerate(verdict.others):
                text = _second_label(verdict, judged, i)
                if text:
                    seconds.append((who_title(*who), text))
            details = list(_details(judged))
            claims.append((judged.claim, shade, label(verdict, judged), seconds, details))
    return rendered(
        "claims.html",
        verdict=verdict,
        claims=claims,
        title=TITLE,
        headline=headline(verdict),
        seconds=second_headlines(verdict),
        untested=untested(verdict),
    )


PRINTED_DIGITS = 2
LABELS = ("Table", "Task", "Method")
MEANINGS = (
    "paper: as it prints it. here: our mean [low, high] (our mean minus the paper's), with "
    "the limits of table `statistics`.",
    "The paper does not say what its ± is taken over, and its models, severities and "
    "episodes are others: numbers show the size of an effect, and the claims its direction.",
)


def numbers_table(verdict: VerdictReport) -> Table | None:
    """Return a table with each printed number beside the measured one, for the tasks of the report;
    None if the paper prints nothing about them.
    """
    keys = list(dict.fromkeys(key for row in verdict.rows for key in row.columns))
    if not verdict.rows:
        return None
    columns = []
    for column in map(COLUMN_OF.__getitem__, keys):
        digits = min(column.digits, PRINTED_DIGITS)
        columns.append(
            replace(
                column, key=f"{column.key}_paper", title=f"{column.title}, paper", digits=digits
            )
        )
        columns.append(replace(column, title=f"{column.title}, here"))
    rows = []
    for row in verdict.rows:
        labels = (
            row.table,
            task_title(row.task),
            who_title(*row.who) + (" [incomplete]" if row.note else ""),
        )
        rows.append(Row(labels, _values(row, keys)))
    total = sum(len(printed) for table in verdict.paper.tables for printed in table.rows.values())
    absent = total - len(rows)
    notes: tuple[str, ...] = ()
    if absent:
        notes = (
            f"{absent} of the paper's rows are of tasks or ablations that this spec does not run.",
        )
    return Table(
        "paper",
        "Comparison with the paper",
        LABELS,
        tuple(columns),
        tuple(rows),
        notes,
        MEANINGS,
        grouping=2,
        ranked=False,
    )


def _values(row: Beside, keys: list[str]) -> tuple[Value, ...]:
    pairs = dict(zip(row.columns, zip(row.printed, row.ours, strict=True), strict=True))
    values: list[Value] = []
    for key in keys:
        printed, ours = pairs.get(key, (None, None))
        theirs = UNDEFINED
        scale = COLUMN_OF[key].scale
        if printed is not None:
            theirs = Value(
                printed.mean / scale,
                None if printed.spread is None else printed.spread / scale,
                ranked=False,
            )
        values += [theirs, UNDEFINED]
        if ours is not None:
            delta = None if theirs.mean is None else ours.value - theirs.mean
            values[-1] = Value(
                ours.value, n=row.seeds, delta=delta, ranked=False, interval=ours.interval
            )
    return tuple(values)
