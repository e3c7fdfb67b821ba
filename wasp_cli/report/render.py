r"""A table in every format, and the files of a report: Markdown, CSV, LaTeX, HTML from templates,
and for a terminal.

All text in HTML is escaped unless it is markup already. A table is a fragment for a page that
brings the style, and may bring a script that sorts (`page/templates/table.html`):

    <figure class="table" id="table1">
      <table>  thead, and one tbody per group of rows
        <th scope="col" class="number" data-better="up">
        <th scope="row">, with class "again" where the row above has the same label of its group
        <td class="number" data-value="6.5">6.50 ± 0.28</td>    unscaled, as in data files; empty
        where it is undefined
      <ul class="notes">, <ul class="meanings">

The best value of a group stands in <strong>, the second best in <u>.

LaTeX compiles with pdfLaTeX and any class, after `\usepackage{booktabs}`; what is optional is left
out of it, data files have it.
"""

from __future__ import annotations

import base64
import csv
import io
import math
import re
import shlex
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from rich import box
from rich.console import Group
from rich.markup import escape
from rich.table import Table as RichTable
from rich.text import Text

from wasp_cli.errors import StoreError
from wasp_cli.report.tables import Row, Table
from wasp_cli.store.records import replace_file

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

WHOLE = re.compile(r"(\d+) of \1 planned cells are")
"""A note that nothing is missing. It is left out of captions, but is in the comments above a table.
"""


def markdown_row(cells: Iterable[object]) -> str:
    """Return a row of a Markdown table. Cells are put on one line, and characters that would end a
    cell are escaped.
    """
    texts = (" ".join(str(cell).split()).replace("|", "\\|") for cell in cells)
    return f"| {' | '.join(texts)} |"


def markdown_text(text: str) -> str:
    """Return a text that somebody has written, escaped so that Markdown shows it as it is: without
    HTML, links and pictures.
    """
    return re.sub(r"([\\\[\]])", r"\\\1", text).replace("&", "&amp;").replace("<", "&lt;")


def markdown(table: Table) -> str:
    """Return a table as Markdown, with its notes."""
    lines = [
        f"## {table.title}",
        "",
        markdown_row([*table.labels, *(column.heading for column in table.columns)]),
    ]
    lines.append("|" + " --- |" * len(table.labels) + " ---: |" * len(table.columns))
    for r in range(len(table.rows)):
        cells = [table.text(r, c) for c in range(len(table.columns))]
        cells = [f"**{text}**" if (r, c) in table.marks else text for c, text in enumerate(cells)]
        lines.append(markdown_row([*table.shown_labels(r), *cells]))
    if table.notes or table.meanings:
        lines += [
            "",
            *(f"- {markdown_text(note)}" for note in table.notes),
            *(f"- {meaning}" for meaning in table.meanings),
        ]
    return "\n".join(lines) + "\n"


def csv_text(table: Table) -> str:
    """Return a table as CSV: unscaled numbers, a line for each row. There are `_sd`, `_low`,
    `_high` and `_delta` columns if the table has such numbers, and `seeds` last.
    """
    columns = data_columns(table)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    labels = len(table.labels)
    for row in zip(*columns.values(), strict=True):
        writer.writerow([*row[:labels], *(plain(number) for number in row[labels:-1]), row[-1]])
    return out.getvalue()


def data_columns(table: Table) -> dict[str, list[Any]]:
    """Return the columns of a data file by name: labels as texts, unscaled numbers, None where
    undefined; `seeds` last.
    """
    parts = [_parts(row) for row in table.rows]
    columns: dict[str, list[Any]] = {}
    for i, label in enumerate(table.labels):
        columns[label.lower().replace(" ", "_")] = [
            (row.names or row.labels)[i] for row in table.rows
        ]
    for c, column in enumerate(table.columns):
        for name in PARTS:
            if name == "" or any(row[c][name] is not None for row in parts):
                columns[column.key + name] = [row[c][name] for row in parts]
    columns["seeds"] = [max((value.n for value in row.values), default=0) for row in table.rows]
    return columns


# endings of the columns that a data file has for a value: mean, sd, limits and difference
PARTS = ("", "_sd", "_low", "_high", "_delta")


def _parts(row: Row) -> list[dict[str, float | None]]:
    """The numbers of each value of a row, by their endings in PARTS."""
    parts = []
    for value in row.values:
        low = None if value.interval is None else value.interval.low
        high = None if value.interval is None else value.interval.high
        numbers = (value.mean, value.sd, low, high, value.delta)
        parts.append(dict(zip(PARTS, numbers, strict=True)))
    return parts


def plain(number: float | None) -> str | float:
    """Return a number for a data file; empty if it is undefined. It has twelve decimals, since the
    last bits of a sum differ between machines.
    """
    if number is None or not math.isfinite(number):
        return ""
    return round(number, 12) + (0.0 if isinstance(number, float) else 0)


def terminal(table: Table, width: int = 120) -> Group:
    """Return a table for a console of `width` characters. Best values are bold, second best ones
    underlined.

    If it does not fit, spreads are left out, then optional columns from the last one on, then
    brackets.
    """
    # What to try, from everything to least: columns, whether with spreads, whether with brackets.
    notes = list(table.notes)
    every = tuple(range(len(table.columns)))
    optional = [c for c in every if table.columns[c].optional]
    attempts = [(every, True, True)]
    for kept in range(len(optional), -1, -1):
        attempts.append((tuple(c for c in every if c not in optional[kept:]), False, True))
    least_columns = attempts[-1][0]
    attempts.append((least_columns, False, False))
    for attempt in attempts:
        rich, least = _rich(table, width, *attempt)
        if least <= width:
            break

    # A note on what is hidden.
    shown, *parts = attempt
    cut = any(
        table.text(r, c, *parts) != table.text(r, c) for r in range(len(table.rows)) for c in shown
    )
    hidden = []
    if len(shown) < len(every):
        hidden.append("columns")
    if cut:
        hidden.append("spreads and brackets")
    if hidden:
        what = " and ".join(hidden).capitalize()
        notes.append(f"{what} hidden; widen the terminal, or see the files.")
    return Group(rich, *(Text(f"- {note}", style="dim") for note in notes))


def _rich(
    table: Table, width: int, shown: tuple[int, ...], spread: bool, delta: bool
) -> tuple[RichTable, int]:
    """A table of some columns, and the least width at which only its headings wrap."""
    # The texts, and the widths of the columns with headings on one line or on several.
    texts = [[table.text(r, c, spread, delta) for c in shown] for r in range(len(table.rows))]
    headings = [table.columns[c].heading for c in shown]
    labels = [
        max(map(len, column))
        for column in zip(table.labels, *(row.labels for row in table.rows), strict=True)
    ]
    numbers = [max(map(len, column)) for column in zip(*texts, strict=True)] or [0] * len(shown)
    loose = [max(number, len(heading)) for number, heading in zip(numbers, headings, strict=True)]
    tight = [
        max(number, *map(len, heading.split()))
        for number, heading in zip(numbers, headings, strict=True)
    ]

    # The table. Each column has a space and a rule beside it.
    frame = sum(labels) + 2 * (len(labels) + len(shown))
    rich = RichTable(
        title=escape(table.title),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    rich.padding = (0, 1, 0, 0)
    fits = frame + sum(tight) <= width
    for label, size in zip(table.labels, labels, strict=True):
        # Labels may wrap, numbers may not.
        rich.add_column(escape(label), width=size if fits else None)
    for heading, size in zip(
        headings, loose if frame + sum(loose) <= width else tight, strict=True
    ):
        rich.add_column(escape(heading), justify="right", width=size)
    for r, line in enumerate(texts):
        if r and table.starts_group(r):
            rich.add_section()
        styles = [_style(table, r, c) for c in shown]
        # Assembled from parts, so that the blanks beside a text have no style.
        cells = [Text.assemble(pair) for pair in zip(line, styles, strict=True)]
        rich.add_row(*(Text(label) for label in table.shown_labels(r)), *cells)
    return rich, frame + sum(tight)


def _style(table: Table, row: int, column: int) -> str:
    if (row, column) in table.marks:
        return "bold green"
    if (row, column) in table.seconds:
        return "underline"
    return ""


WIDE = 5  # columns of numbers from which on a table spans both columns of a page

SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "_": r"\_",
    "%": r"\%",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "`": "{}`",
    "[": "{[}",
    "]": "{]}",
    "*": "{*}",
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "→": r"$\rightarrow$",
    "×": r"$\times$",
    "·": r"$\cdot$",
    "²": "$^2$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "≠": r"$\neq$",
    "≈": r"$\approx$",
    "∞": r"$\infty$",
    "‖": r"$\|$",
    "−": "$-$",
    "α": r"$\alpha$",
    "β": r"$\beta$",
    "γ": r"$\gamma$",
    "δ": r"$\delta$",
    "ε": r"$\epsilon$",
    "κ": r"$\kappa$",
    "λ": r"$\lambda$",
    "μ": r"$\mu$",
    "π": r"$\pi$",
    "ρ": r"$\rho$",
    "σ": r"$\sigma$",
    "τ": r"$\tau$",
    "Δ": r"$\Delta$",
    "Σ": r"$\Sigma$",
    "–": "--",
    "—": "---",
    "‘": "`",
    "’": "'",
    "“": "``",
    "”": "''",
    "…": r"\dots{}",
}
"""The LaTeX of a character. `[` and `*` are in braces: after a line break they would be its
arguments.
"""

OF_NUMBERS = str.maketrans(
    {"-": "$-$", "+": "$+$", "±": SPECIAL["±"], "[": SPECIAL["["], "]": SPECIAL["]"]}
)
"""The LaTeX of the characters in a number with its spread and its brackets."""

JOINED = re.compile(r"([-,'`])(?=\1)")  # neighbours that LaTeX would print as one character

ACCENTS = {
    "\u0300": "`",
    "\u0301": "'",
    "\u0302": "^",
    "\u0303": "~",
    "\u0304": "=",
    "\u0306": "u",
    "\u0307": ".",
    "\u0308": '"',
    "\u030a": "r",
    "\u030b": "H",
    "\u030c": "v",
    "\u0327": "c",
}
"""Commands of combining characters."""


def latex(table: Table) -> str:
    """Return a `table` environment, `table*` for a wide one, with the notes in its caption and in
    comments above it.
    """
    return "\n".join(_lines(table)) + "\n"


def escaped(text: str) -> str:
    """Return a text on one line, escaped for LaTeX. A character that plain pdfLaTeX does not have
    is replaced by its code point.
    """
    pieces = JOINED.split(unicodedata.normalize("NFC", " ".join(text.split())))
    return "".join(
        f"{piece}{{}}" if i % 2 else "".join(map(_escaped, piece)) for i, piece in enumerate(pieces)
    )


def _escaped(character: str) -> str:
    if character in SPECIAL:
        return SPECIAL[character]
    if " " <= character <= "~":
        return character
    base, *marks = list(unicodedata.normalize("NFD", character))
    if base.isascii() and base.isalpha() and len(marks) == 1 and marks[0] in ACCENTS:
        return rf"\{ACCENTS[marks[0]]}{{{base}}}"
    return rf"\texttt{{U+{ord(character):04X}}}"


def _lines(table: Table) -> Iterator[str]:
    shown = [c for c, column in enumerate(table.columns) if not column.optional]
    comments = [r"Needs \usepackage{booktabs}.", *table.notes, *table.meanings]
    absent = ", ".join(column.title for column in table.columns if column.optional)
    if absent:
        comments.append(f"Left out: {absent}.")
    yield from (f"% {' '.join(comment.split())}" for comment in comments)
    environment = "table*" if len(shown) > WIDE else "table"
    yield rf"\begin{{{environment}}}"
    yield r"\centering\small"
    yield rf"\caption{{{escaped(_caption(table))}}}"
    yield rf"\label{{tab:{re.sub('[^0-9A-Za-z]', '-', table.name)}}}"
    yield rf"\begin{{tabular}}{{{'l' * len(table.labels)}{'r' * len(shown)}}}"
    yield r"\toprule"
    yield _line([*map(escaped, table.labels), *(escaped(table.columns[c].heading) for c in shown)])
    for r in range(len(table.rows)):
        if table.starts_group(r):
            yield r"\midrule"
        cells = []
        for c in shown:
            text = table.text(r, c).translate(OF_NUMBERS)
            if (r, c) in table.marks:
                text = rf"\textbf{{{text}}}"
            elif (r, c) in table.seconds:
                text = rf"\underline{{{text}}}"
            cells.append(text)
        yield _line([*map(escaped, table.shown_labels(r)), *cells])
    yield r"\bottomrule"
    yield r"\end{tabular}"
    yield rf"\end{{{environment}}}"


def _caption(table: Table) -> str:
    sentences = [table.title if table.title.endswith((".", "?")) else f"{table.title}."]
    if table.marks:
        sentences.append("Best values are bold.")
    if table.seconds:
        sentences.append("Second best values are underlined.")
    sentences += [note for note in table.notes if not WHOLE.match(note)]
    return " ".join(sentences)


def _line(cells: list[str]) -> str:
    return " & ".join(cells) + r" \\"


def html(table: Table) -> str:
    """Return a table as a fragment of HTML; see the module."""
    return str(rendered("table.html", table=table))


TEMPLATES = ("wasp_cli.report", "page/templates")


def rendered(template: str, /, **values: Any) -> Markup:
    """Fill a template of `page/templates`; an undefined name is an error."""
    from markupsafe import Markup

    # every value in it has been escaped
    return Markup(templates(TEMPLATES).get_template(template).render(values))


def trusted(name: str) -> Markup:
    """Return a file of `page` as markup that is not escaped: it is part of this package."""
    from markupsafe import Markup

    return Markup((files("wasp_cli.report") / "page" / name).read_text(encoding="utf-8"))


@cache
def templates(*folders: tuple[str, str]) -> Environment:
    """Return the templates in some folders of packages, with autoescaping. If several have a name,
    the first folder's counts.
    """
    # Imported here: most commands write no HTML.
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=ChoiceLoader(list(starmap(PackageLoader, folders))),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals |= {"plain": plain, "data_uri": data_uri}
    return environment


def data_uri(data: bytes, mime: str) -> str:
    """Return data as an address that needs no file."""
    return f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"


RENDERERS: dict[str, Callable[[Table], str]] = {
    "md": markdown,
    "csv": csv_text,
    "tex": latex,
    "html": html,
}


def make_own(folder: Path, names: Iterable[str] = ()) -> None:
    """Make the folder of a report, and remove links of these names in it, which would be taken for
    its own files.

    Raises:
        StoreError: the folder is a link.
    """
    if folder.is_symlink():
        raise StoreError(f"'{folder}' is a link; reports are written to folders of the results")
    folder.mkdir(parents=True, exist_ok=True)
    for path in map(folder.joinpath, names):
        if path.is_symlink():
            path.unlink()


def write_pages(folder: Path, pages: Mapping[str, str], tables: Sequence[Table]) -> list[Path]:
    """Write pages (name: text) and every table in every format; returns the files, the pages
    first.
    """
    texts = dict(pages)
    texts |= {
        f"{table.name}.{ending}": render(table)
        for table in tables
        for ending, render in RENDERERS.items()
    }
    for name, text in texts.items():
        replace_file(folder / name, text)
    return [folder / name for name in texts]


# characters that addresses show as they are; browsers send %20 for a space
READABLE = "/ =+"


def cell_address(cell: str, episode: int | None = None, step: int | None = None) -> str:
    """Return the address of a cell (its label or key), of an episode or of a decision in the
    viewer, such as `/cell/goal1 s1 wasp laggy=0.7/episode/3?step=100`.
    """
    place = f"/cell/{quote(cell, READABLE)}"
    place += "" if episode is None else f"/episode/{episode}"
    return place if step is None else f"{place}?step={step}"


def open_command(results: Path | str, address: str) -> str:
    """Return the command that opens a page of `wasp view`."""
    return f"wasp view {shlex.quote(str(results))} --page {shlex.quote(address)}"
