"""The layout of explanations: headings, fields and tables as lines of text, and numbers."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Sequence
from itertools import groupby

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from wasp_cli.report.explain.facts import Range

INDENT = 2  # characters before a table
BETWEEN = 2  # between two of its columns
NUMBER = re.compile(r"[-+.…%\d]*")


def set_out(parts: Iterable[RenderableType], width: int) -> list[Text]:
    """Return parts as lines of text that are at most `width` wide."""
    console = Console(file=io.StringIO(), markup=False, emoji=False, highlight=False)
    lines = []
    for segments in console.render_lines(
        Group(*parts), console.options.update(width=width), pad=False
    ):
        line = Text.assemble(
            *((segment.text, segment.style or "") for segment in Segment.simplify(segments))
        )
        line.rstrip()
        lines.append(line)
    return lines


def heading(text: str, more: str = "") -> Text:
    """Return a heading, with a remark in brackets."""
    return Text.assemble((text, "bold"), (f"  ({more})" if more else "", "dim"))


def section(title: str, *parts: RenderableType) -> list[RenderableType]:
    """Return parts below an empty line and a heading."""
    return ["", heading(title), *parts]


def fields(entries: Iterable[tuple[str, str]]) -> RenderableType:
    """Set names and values in two columns."""
    grid = Table.grid(padding=(0, BETWEEN, 0, 0))
    grid.add_column(style="dim", no_wrap=True)
    for entry in entries:
        grid.add_row(*entry)
    return _indented(grid)


def table(
    titles: Sequence[str], rows: Sequence[Sequence[str | Text]], styles: Sequence[str] = ()
) -> RenderableType:
    """Return rows as a table: numbers are aligned right, words left. A column with nothing but `-`
    is left out.

    Args:
        styles: a style of rich for each row; none: no styles.
    """
    columns = [
        (title, cells)
        for title, *cells in zip(titles, *rows, strict=True)
        if {*map(str, cells)} != {"-"}
    ]
    drawn = Table(box=None, padding=(0, BETWEEN, 0, 0), pad_edge=False, header_style="bold")
    for i, (title, cells) in enumerate(columns):
        are_numbers = all(NUMBER.fullmatch(str(cell)) for cell in cells)
        drawn.add_column(title, justify="right" if i > 0 and are_numbers else "left")
    for i, row in enumerate(zip(*(cells for _, cells in columns), strict=True)):
        drawn.add_row(*row, style=styles[i] if styles else "")
    return _indented(drawn)


def notes(*texts: str) -> list[RenderableType]:
    """Return remarks, each on its own line; empty ones are left out."""
    return [_indented(Text(text, "dim")) for text in texts if text]


def _indented(part: RenderableType) -> Padding:
    return Padding(part, (0, 0, 0, INDENT), expand=False)


def action(values: Sequence[float]) -> str:
    """Return an action, or a command, of which at most four numbers are shown."""
    shown = [plain(value, sign=True) for value in values[:4]]
    if len(values) > 4:
        shown.append("...")
    return f"({', '.join(shown)})"


def plain(value: float, sign: bool = False) -> str:
    """Return a number with two decimals; with `sign` also a plus."""
    return f"{round(value, 2) + 0.0:{'+' if sign else ''}.2f}"


def short(value: float | None, digits: int = 3) -> str:
    """Return a number with some decimals; `-` for None."""
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"


def beside(value: float | None, limit: float | None) -> tuple[str, str]:
    """Return a value and its limit with as many decimals as tell them apart, up to eight."""
    digits = 3
    while (
        value is not None
        and limit is not None
        and value != limit
        and short(value, digits) == short(limit, digits)
        and digits < 8
    ):
        digits += 1
    return short(value, digits), short(limit, digits)


def between(bounds: Range | None, limit: float | None) -> str:
    """Return a range; its upper end is told apart from the threshold."""
    if bounds is None:
        return "-"
    low = short(bounds[0])
    high = beside(bounds[1], limit)[0]
    return low if low == high else f"{low}…{high}"


def span(first: int, last: int) -> str:
    """Return a range of decisions; a single one alone."""
    return f"{first}" if first == last else f"{first}-{last}"


def places(decisions: Sequence[int]) -> str:
    """Return decisions as ranges, such as `3, 7-9`: the first four, then how many more decisions
    there are; `-` without any.
    """
    # Within a range a decision and its place in the list are as far apart as those before it.
    ranges = [
        [t for _, t in part]
        for _, part in groupby(enumerate(decisions), lambda placed: placed[1] - placed[0])
    ]
    if not ranges:
        return "-"
    parts = [span(each[0], each[-1]) for each in ranges[:4]]
    more = sum(map(len, ranges[4:]))
    if more:
        parts.append(f"{more} more")
    return ", ".join(parts)


def count(number: int, thing: str) -> str:
    """Return a number of things in words."""
    return f"{number} {thing}{'' if number == 1 else 's'}"


def ms(value: float) -> str:
    """Return a time in ms, or from a second on in s."""
    return f"{value:.3g} ms" if value < 1000 else f"{value / 1000:.3g} s"
