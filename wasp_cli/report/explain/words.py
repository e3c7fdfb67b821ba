"""Words, numbers and lines that the texts share."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from rich.text import Text

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.report.explain.facts import Range, Who
from wasp_cli.report.explain.stored import Constants
from wasp_cli.report.tables.titles import ABLATIONS
from wasp_cli.tasks.registry import TASKS

INDENT = 2
LABEL = 16
"""Columns of the indentation and of the names at the left."""

RULES = {
    "human": "Human-only never intervenes: the command is executed as it is.",
    "expert": "The unimpaired operator without assistance: the command is executed as it is.",
    "ida": "IDA puts its copilot's action (the expert's, unless the spec says otherwise) in the place of the command where an ensemble "
    "of Q functions votes for it.",
    "diffusion": "Diffusion has no gate: every command is blurred with noise and led back towards what an expert would do.",
    "filter": "The safety filter looks one imagined step ahead: where that step and V_c behind it cost more than τ_c, it makes the least "
    "correction towards the safest action that brings the cost below.",
    "saferl": "SafeRL-Res has no gate: a trained policy adds its correction to every command.",
}
"""How a method without WASP's gates decides."""

SIGNALS = {"ida": "vote", "filter": "Q_c"}
"""What a method decides by; others call it their signal."""
DECIDERS = {"ida": "IDA", "filter": "filter"}
"""Who decides by it."""

STYLES = {"safety": "yellow", "task": "cyan", "method": "magenta", "none": "dim"}


def whose(who: Who, width: int) -> list[Text]:
    """Task, method, operator, seed and key."""
    task = TASKS[who.task].title if who.task in TASKS else who.task
    method = METHODS[who.method].title if who.method in METHODS else who.method
    if who.assistant_variant != "full":
        method += f", {ABLATIONS.get(who.assistant_variant, who.assistant_variant)}"
    of = f"{task}, {method}, operator: {operator(who)}, seed {who.seed} (world {who.episode_seed})"
    return entry("cell", of, width) + entry("key", who.key or f"none; read from {who.path}", width)


def operator(who: Who) -> str:
    """The operator with the meaning of its severity."""
    if who.operator == UNIMPAIRED:
        return "unimpaired"
    value = "" if who.value is None else f" {who.value:g}"
    if who.operator not in OPERATORS:
        return who.operator + value
    info = OPERATORS[who.operator]
    return f"{info.title.lower()}{value} ({info.unit})"


def rule(who: Who) -> str:
    """How a method without gates decides."""
    return RULES.get(who.method, f"What moves '{who.method}', its own documentation says; it has none of WASP's gates.")


def expected_cost(amount: str, constants: Constants) -> str:
    """What an amount of G^c means."""
    if constants.bootstrap_cost:
        return f"a discounted cost of {amount}, a critic's view beyond the horizon included, is to be expected"
    within = "the planning horizon (H)" if constants.horizon is None else f"the next {constants.horizon}"
    return f"{amount} costly decisions within {within}, discounted, are to be expected"


def not_in_file(what: Sequence[str], who: Who, width: int) -> list[Text]:
    """What an older table does not say."""
    if not what:
        return []
    text = f"{'; '.join(what)} (table version {who.table_version}; a new run of the cell records them)"
    return entry("not in the file", text, width)


def title(text: str, more: str = "") -> Text:
    """A heading."""
    return Text(text, "bold").append(f"  ({more})" if more else "", "dim not bold")


def entry(label: str, text: str, width: int, style: str = "") -> list[Text]:
    """A name at the left and a text beside it."""
    lines = wrapped(text, width, INDENT + LABEL) or [""]
    first = Text(" " * INDENT + label.ljust(LABEL), "dim").append(lines[0][INDENT + LABEL :], f"not dim {style}")
    return [first, *(Text(line, style) for line in lines[1:])]


def wrapped(text: str, width: int, indent: int) -> list[str]:
    """A text as indented lines."""
    space = " " * indent
    if "  " in text:  # set in columns: not to be filled
        return [space + text]
    filler = textwrap.TextWrapper(max(width, indent + 20), space, space, break_long_words=False, break_on_hyphens=False)
    whole = text.replace("Eq. ", "Eq.\u00a0")  # a number stays with its name
    return [line.replace("\u00a0", " ") for line in filler.wrap(whole)]


def action(values: Sequence[float]) -> str:
    """An action [A]; the first four numbers of a long one."""
    shown = [plain(value, sign=True) for value in values[:4]]
    return f"({', '.join([*shown, '...'] if len(values) > 4 else shown)})"


def plain(value: float, sign: bool = False) -> str:
    """Two digits, and no negative zero."""
    return f"{round(value, 2) + 0.0:{'+' if sign else ''}.2f}"


def short(value: float | None, digits: int = 3) -> str:
    """A number that may be undefined."""
    return "?" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"


def beside(value: float | None, limit: float | None) -> tuple[str, str]:
    """A value and its threshold with as many digits as it takes to tell them apart."""
    digits = 3
    while value is not None and limit is not None and value != limit and short(value, digits) == short(limit, digits) and digits < 8:
        digits += 1
    return short(value, digits), short(limit, digits)


def between(bounds: Range | None, limit: float | None) -> str:
    """A range; its upper end is told apart from the threshold."""
    if bounds is None:
        return "-"
    low, high = short(bounds[0]), beside(bounds[1], limit)[0]
    return low if low == high else f"{low}…{high}"


def span(first: int, last: int) -> str:
    """Decisions from one to another."""
    return f"{first}" if first == last else f"{first}-{last}"


def places(decisions: Sequence[int]) -> str:
    """Decisions as ranges: `3, 7-9`; the first four, then how many more decisions there are."""
    spans: list[list[int]] = []
    for t in decisions:
        if spans and t == spans[-1][1] + 1:
            spans[-1][1] = t
        else:
            spans.append([t, t])
    more = sum(last - first + 1 for first, last in spans[4:])
    return ", ".join([span(first, last) for first, last in spans[:4]] + ([f"{more} more"] if more else [])) or "-"


def count(number: int, thing: str) -> str:
    """1 goal, 2 goals."""
    return f"{number} {thing}{'' if number == 1 else 's'}"


def ms(value: float) -> str:
    """A time in milliseconds, three digits."""
    return f"{value:.3g} ms" if value < 1000 else f"{value / 1000:.3g} s"
