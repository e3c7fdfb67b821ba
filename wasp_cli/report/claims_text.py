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
SAID = 70  # characters of a claim that is only named


def label(verdict: VerdictReport, judged: Judged) -> str:
    if judged.outcome != "untested" or judged.part == "untested":
        return PLAIN[judged.outcome] + _about(verdict, judged.outcome)
    return f"in part: {PLAIN[judged.part]}{_about(verdict, judged.part)}"


def headline(verdict: VerdictReport) -> str:
    parts = [
        _counted(len(judged), outcome, verdict)
        for outcome in ("holds", "fails", "undecided")
        if (judged := verdict.having(outcome))
    ]
    rest = Counter(judged.part for judged in verdict.having("untested"))
    partly = [
        _counted(rest[outcome], outcome, verdict)
        for outcome in ("holds", "undecided")
        if rest[outcome]
    ]
    if partly:
        tested = rest["holds"] + rest["undecided"]
        parts.append(
            f"{tested} {'is' if tested == 1 else 'are'} tested in part ({', '.join(partly)})"
        )
    if rest["untested"]:
        parts.append(_counted(rest["untested"], "untested", verdict))
    return (
        f"Of {len(verdict.claims)} claim{'s' if len(verdict.claims) != 1 else ''} "
        f"{'; '.join(parts)}."
    )


def second_headlines(verdict: VerdictReport) -> list[str]:
    sentences = []
    for i, who in enumerate(verdict.others):
        pairs = [
            (one.outcome, other.outcome)
            for one in verdict.claims
            if (other := one.others[i]) and other.outcome != "untested"
        ]
        counts = Counter(outcome for _, outcome in pairs)
        said = [
            _counted(counts[outcome], outcome, verdict)
            for outcome in ("holds", "fails", "undecided")
            if counts[outcome]
        ]
        changed = sum(own != other for own, other in pairs)
        place = f"{who_title(*who)} in place of {who_title(*stood_for(who))}"
        sentences.append(
            f"Judged by {place}: {'; '.join(said)}; {changed} of {len(pairs)} verdicts differ."
            if pairs
            else ""
        )
    return [text for text in sentences if text]


def _second_label(verdict: VerdictReport, judged: Judged, i: int) -> str:
    other = judged.others[i]
    return "" if other is None or other.part == "untested" else label(verdict, other)


def _counted(count: int, outcome: Outcome, verdict: VerdictReport) -> str:
    one, many = {
        "holds": ("holds", "hold"),
        "fails": ("does not hold", "do not hold"),
        "undecided": ("is undecided", "are undecided"),
        "untested": ("is not tested", "are not tested"),
    }[outcome]
    return f"{count} {one if count == 1 else many}{_about(verdict, outcome)}"


def _about(verdict: VerdictReport, outcome: Outcome) -> str:
    if outcome == "undecided":
        return f" with {verdict.seeds} seed{'s' if verdict.seeds != 1 else ''}"
    return " for these models" if verdict.one_training and outcome in ("holds", "fails") else ""


def untested(verdict: VerdictReport) -> str:
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
    asked = answer.asked
    column = COLUMN_OF[answer.asked.column]
    sides = [f"{who_title(*asked.left)} {column.number(answer.left)}"]
    what = f"{task_title(asked.task)} {column.title}"
    if asked.right is not None:
        sides.append(f"{who_title(*asked.right)} {column.number(answer.right)}")
    t = (
        f"; t {limits}"
        if (limits := _limits(answer, answer.contrast.t if answer.contrast else None))
        else ""
    )
    contrast = ""
    if answer.contrast is not None:
        contrast = (
            f"{_signed(answer, answer.contrast.value)} "
            f"({_limits(answer, answer.contrast.bootstrap) or 'no interval'})"
        )
    return f"{what}: {', '.join(sides)}; {contrast}{t}, needed: {needed(answer)}"


def _limits(answer: Answer, limits: Limits | None) -> str:
    return "" if limits is None else " to ".join(_signed(answer, limit) for limit in limits)


def _signed(answer: Answer, value: float) -> str:
    # "+0.00 does not hold" would hide on which side of 0 it lies
    column = COLUMN_OF[answer.asked.column]
    hidden = value and not round(value * column.scale, column.digits)
    return f"{value * column.scale:+.1g}" if hidden else column.number(value, True)


def needed(answer: Answer) -> str:
    asked = answer.asked
    other = "right" if asked.bound is None else COLUMN_OF[asked.column].number(asked.bound)
    margin = (
        f" {'+' if signed_margin(asked) < 0 else '-'} {asked.margin:g} |right|"
        if asked.margin
        else ""
    )
    return f"left - {other}{margin} {SIDES[asked.relation]} 0"


def printed(answer: Answer) -> str:
    numbers = [f"{number.mean:g}" for number in answer.printed if number is not None]
    return " and ".join(numbers) if answer.shown_in_print is not None else ""


def beyond_print(judged: Judged) -> str:
    odd = [
        answer
        for answers in judged.answers
        if all(one.shown_in_print is False for one in answers)
        for answer in answers
    ]
    shown = [
        f"{task_title(one.asked.task)} {COLUMN_OF[one.asked.column].title} {printed(one)}"
        for one in odd
    ]
    return f"The paper's own means do not show it: {few(shown)}." if shown else ""


def verdict_terminal(verdict: VerdictReport) -> Text:
    """Count the claims in one line; the written report has each of them, with the comparisons
    that decide it.
    """
    line = " ".join((headline(verdict), *second_headlines(verdict)))
    return Text.assemble(
        (f"{TITLE}: ", "bold"), f"{line[0].lower()}{line[1:-1]}; report.html lists them."
    )


def verdict_markdown(verdict: VerdictReport) -> str:
    lines = [
        f"## {TITLE}",
        "",
        f"*{verdict.paper.title}*. {headline(verdict)}",
        "",
        *(f"- {note}" for note in verdict.notes),
        "",
    ]
    if told := second_headlines(verdict):
        titles = [who_title(*who) for who in verdict.others]
        lines += [
            *told,
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
    for judged in verdict.claims:
        if judged.outcome != "untested" or judged.part != "untested":
            claim = judged.claim
            lines.append(
                f"- **{label(verdict, judged)}**: {claim.says} (`{claim.id}`, section "
                f"{claim.section})"
            )
            lines += [f"  - {text}" for text in _told(judged)]
    if text := untested(verdict):
        lines += ["", text]
    return "\n".join(lines) + "\n"


def _told(judged: Judged) -> Iterator[str]:
    if judged.claim.reading:
        yield f"Read as: {judged.claim.reading}"
    for answers in judged.answers:
        asked = [
            f"{sentence(answer)}: "
            f"{PLAIN[answer.outcome]}{f' (paper: {theirs})' if (theirs := printed(answer)) else ''}"
            for answer in answers
            if answer.outcome != "untested"
        ]
        if asked:
            yield f"{'one is enough: ' * (len(answers) > 1)}{'; or '.join(asked)}"
    if lacking := _lacking([judged]):
        yield f"Not tested: {few(lacking)}."
    if beyond := beyond_print(judged):
        yield beyond


def verdict_html(verdict: VerdictReport) -> Markup:
    claims = []
    for judged in verdict.claims:
        if judged.part != "untested":
            shade = judged.outcome if judged.outcome != "untested" else f"{judged.part} part"
            labels = (_second_label(verdict, judged, i) for i in range(len(verdict.others)))
            seconds = [
                (who_title(*who), text)
                for who, text in zip(verdict.others, labels, strict=True)
                if text
            ]
            claims.append(
                (judged.claim, shade, label(verdict, judged), seconds, list(_told(judged)))
            )
    told = {
        "title": TITLE,
        "headline": headline(verdict),
        "seconds": second_headlines(verdict),
        "untested": untested(verdict),
    }
    return rendered("claims.html", verdict=verdict, claims=claims, **told)


PRINTED_DIGITS = 2
LABELS = ("Table", "Task", "Method")
MEANINGS = (
    "paper: as it prints it. here: our mean [low, high] (our mean minus the paper's), with "
    "the limits of table `statistics`.",
    "The paper does not say what its ± is taken over, and its models, severities and "
    "episodes are others: numbers show the size of an "
    "effect, and the claims its direction.",
)


def numbers_table(verdict: VerdictReport) -> Table | None:
    """Return each printed number beside the measured one, for the tasks that are here; None
    where the paper prints nothing of them.
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
    absent = sum(
        len(printed) for table in verdict.paper.tables for printed in table.rows.values()
    ) - len(rows)
    notes = (
        [f"{absent} of the paper's rows are of tasks or ablations that this spec does not run."]
        if absent
        else []
    )
    head = ("paper", "Comparison with the paper", LABELS, tuple(columns))
    return Table(*head, tuple(rows), tuple(notes), MEANINGS, grouping=2, ranked=False)


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
