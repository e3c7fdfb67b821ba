"""What the tables of an episode and of a decision share: headings, fields, columns, notes, and how numbers are printed."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence

from rich.text import Text

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.report.explain.facts import Range, Who
from wasp_cli.report.explain.stored import Constants
from wasp_cli.report.tables.table import who_title
from wasp_cli.tasks.registry import TASKS

INDENT = 2
NUMBER = re.compile(r"[-+.…%\d]*")
STYLES = {"safety": "yellow", "task": "cyan", "method": "magenta", "late": "red", "none": "dim"}
"""By name of the gate."""


def heading(text: str, more: str = "") -> Text:
    """Return a heading."""
    return Text(text, "bold").append(f"  ({more})" if more else "", "dim not bold")


def sentence(text: str, width: int) -> list[Text]:
    """Set a sentence below a heading."""
    return [Text(line) for line in _wrapped(text, width, 0)]


def fields(entries: Iterable[tuple[str, str]], width: int) -> list[Text]:
    """Set names at the left and their values beside them, wrapped."""
    entries = list(entries)
    indent = INDENT + max((len(name) for name, _ in entries), default=0) + 2
    lines = []
    for name, value in entries:
        first, *more = _wrapped(value, width, indent) or [""]
        lines.append(Text(" " * INDENT + name.ljust(indent - INDENT), "dim").append(first[indent:], "not dim"))
        lines += map(Text, more)
    return lines


def table(
    titles: Sequence[str], rows: Sequence[Sequence[str]], width: int, styles: Sequence[str] = (), drop: Sequence[str] = ()
) -> list[Text]:
    """Set rows in columns: numbers at the right, words at the left. A column of `-` alone is left out.

    Args:
        titles: one for each column.
        rows: the cells of each row; `-` where there is nothing to say.
        width: columns of the terminal.
        styles: one for each row.
        drop: titles of the columns that are left out where there is no room, the first one first.
    """
    columns = [(title, cells) for title, *cells in zip(titles, *rows, strict=True) if set(cells) != {"-"}]
    sizes = {title: max(map(len, (title, *cells))) for title, cells in columns}
    for title in drop:
        if title in sizes and INDENT + sum(size + 2 for size in sizes.values()) - 2 > width:
            del sizes[title]
    lines = [" " * INDENT] * (len(rows) + 1)
    for i, (title, cells) in enumerate(column for column in columns if column[0] in sizes):
        right = i > 0 and all(NUMBER.fullmatch(cell) for cell in cells)
        for k, text in enumerate((title, *cells)):
            lines[k] += "  " * (i > 0) + (text.rjust(sizes[title]) if right else text.ljust(sizes[title]))
    return [Text(line.rstrip(), style) for line, style in zip(lines, ("bold", *styles, *[""] * len(rows)), strict=False)]


def notes(width: int, *texts: str) -> list[Text]:
    """Set notes below a table, each from a line of its own; empty ones are left out."""
    return [Text(line, "dim") for text in texts for line in _wrapped(text, width, INDENT)]


def _wrapped(text: str, width: int, indent: int) -> list[str]:
    space = " " * indent
    filler = textwrap.TextWrapper(max(width, indent + 20), space, space, break_long_words=False, break_on_hyphens=False)
    whole = text.replace("Eq. ", "Eq.\u00a0")  # a number stays with its name
    return [line.replace("\u00a0", " ") for line in filler.wrap(whole)]


def cell_fields(who: Who) -> list[tuple[str, str]]:
    """Return the fields that say which cell it is, and how its method decides."""
    task = TASKS[who.task].title if who.task in TASKS else who.task
    rule = METHODS[who.method].rule if who.method in METHODS else ""
    return [
        ("cell", f"{task}, {who_title(who.method, who.variant)}, seed {who.seed}, world {who.episode_seed}"),
        ("operator", _operator(who)),
        ("method", rule or f"not described: see the documentation of '{who.method}'"),
        ("key", who.key or f"none; read from {who.path}"),
    ]


def _operator(who: Who) -> str:
    """Return the operator with the meaning of its severity."""
    if who.operator == UNIMPAIRED:
        return "unimpaired"
    value = "" if who.value is None else f" {who.value:g}"
    if who.operator not in OPERATORS:
        return who.operator + value
    info = OPERATORS[who.operator]
    return f"{info.title.lower()}{value} ({info.unit})"


def decider(method: str) -> str:
    """Return who decides by a method's own rule: its title."""
    return METHODS[method].title if method in METHODS else method


def cost_meaning(constants: Constants) -> str:
    """Return what a value of G^c means."""
    if constants.bootstrap_cost:
        return f"G^c: expected discounted cost if {goes_on(constants)}, with the critic beyond the horizon (Eq. 9)"
    within = "the horizon H" if constants.horizon is None else f"the next {count(constants.horizon, 'decision')}"
    return f"G^c: expected costly decisions within {within}, discounted, if {goes_on(constants)} (Eq. 9)"


def goes_on(constants: Constants) -> str:
    """Say who is imagined behind the command."""
    return "the expert follows" if constants.takeover else "the operator goes on alone"


def gain_meaning(constants: Constants) -> str:
    """Return what a value of ΔG means."""
    if constants.takeover:
        return "ΔG: expected gain in return by the expert's action now, where the safety gate is silent (Eq. 12)"
    tried = "" if constants.probe is None else f" of {constants.probe} that are tried"
    return f"ΔG: expected gain in return by the best safe correction{tried}, where the safety gate is silent (Eq. 12)"


def action(values: Sequence[float]) -> str:
    """Return an action [A] as text; of a long one the first four numbers."""
    shown = [plain(value, sign=True) for value in values[:4]]
    return f"({', '.join([*shown, '...'] if len(values) > 4 else shown)})"


def plain(value: float, sign: bool = False) -> str:
    """Return a number with two digits, and no negative zero."""
    return f"{round(value, 2) + 0.0:{'+' if sign else ''}.2f}"


def short(value: float | None, digits: int = 3) -> str:
    """Return a number, or `-` for an undefined one."""
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"


def beside(value: float | None, limit: float | None) -> tuple[str, str]:
    """Return a value and its threshold with as many digits as it takes to tell them apart."""
    digits = 3
    while value is not None and limit is not None and value != limit and short(value, digits) == short(limit, digits) and digits < 8:
        digits += 1
    return short(value, digits), short(limit, digits)


def between(bounds: Range | None, limit: float | None) -> str:
    """Return a range; its upper end is told apart from the threshold."""
    if bounds is None:
        return "-"
    low, high = short(bounds[0]), beside(bounds[1], limit)[0]
    return low if low == high else f"{low}…{high}"


def span(first: int, last: int) -> str:
    """Return decisions from one to another."""
    return f"{first}" if first == last else f"{first}-{last}"


def places(decisions: Sequence[int]) -> str:
    """Return decisions as ranges: `3, 7-9`; the first four, then how many more decisions there are."""
    spans: list[list[int]] = []
    for t in decisions:
        if spans and t == spans[-1][1] + 1:
            spans[-1][1] = t
        else:
            spans.append([t, t])
    more = sum(last - first + 1 for first, last in spans[4:])
    return ", ".join([span(first, last) for first, last in spans[:4]] + ([f"{more} more"] if more else [])) or "-"


def count(number: int, thing: str) -> str:
    """Return a count: 1 goal, 2 goals."""
    return f"{number} {thing}{'' if number == 1 else 's'}"


def ms(value: float) -> str:
    """Return a time in milliseconds, with three digits."""
    return f"{value:.3g} ms" if value < 1000 else f"{value / 1000:.3g} s"
