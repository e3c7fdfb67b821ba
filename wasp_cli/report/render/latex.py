r"""A table for a paper: LaTeX with booktabs, best values bold, second best underlined, everything escaped.

The text compiles with pdfLaTeX and any class, after `\usepackage{booktabs}`. Optional columns are left out; data files have them.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator

from wasp_cli.report.tables.table import Table

WIDE = 5
"""Columns of numbers from which on a table spans both columns of a page."""

SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "_": r"\_", "%": r"\%",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}",
    '"': "''", "`": "{}`", "[": "{[}", "]": "{]}", "*": "{*}",
    "±": r"$\pm$", "↑": r"$\uparrow$", "↓": r"$\downarrow$", "→": r"$\rightarrow$", "×": r"$\times$", "·": r"$\cdot$", "²": "$^2$",
    "≤": r"$\leq$", "≥": r"$\geq$", "≠": r"$\neq$", "≈": r"$\approx$", "∞": r"$\infty$", "‖": r"$\|$", "−": "$-$",
    "α": r"$\alpha$", "β": r"$\beta$", "γ": r"$\gamma$", "δ": r"$\delta$", "ε": r"$\epsilon$", "κ": r"$\kappa$", "λ": r"$\lambda$",
    "μ": r"$\mu$", "π": r"$\pi$", "ρ": r"$\rho$", "σ": r"$\sigma$", "τ": r"$\tau$", "Δ": r"$\Delta$", "Σ": r"$\Sigma$",
    "–": "--", "—": "---", "‘": "`", "’": "'", "“": "``", "”": "''", "…": r"\dots{}",
}  # fmt: skip
"""What stands for a character. In braces, `[` and `*` do not belong to the end of the line above."""

JOINED = re.compile(r"([-,'`])(?=\1)")
"""Neighbours that LaTeX would print as one character."""

ACCENTS = {
    "\u0300": "`", "\u0301": "'", "\u0302": "^", "\u0303": "~", "\u0304": "=", "\u0306": "u", "\u0307": ".", "\u0308": '"',
    "\u030a": "r", "\u030b": "H", "\u030c": "v", "\u0327": "c",
}  # fmt: skip
"""Commands of combining characters."""


def latex(table: Table) -> str:
    """Render a `table` environment, `table*` for a wide one, with the notes in its caption and in comments above it."""
    return "\n".join(_lines(table)) + "\n"


def escaped(text: str) -> str:
    """Return any text on one line, as LaTeX prints it; a character that plain pdfLaTeX does not have is named by its code point."""
    pieces = JOINED.split(unicodedata.normalize("NFC", " ".join(text.split())))
    return "".join(f"{piece}{{}}" if i % 2 else "".join(map(_escaped, piece)) for i, piece in enumerate(pieces))


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
    absent = ", ".join(column.title for column in table.columns if column.optional)
    comments = [r"Needs \usepackage{booktabs}.", *table.notes, *table.meanings, *[f"Left out: {absent}."] * bool(absent)]
    yield from (f"% {' '.join(comment.split())}" for comment in comments)
    environment = "table*" if len(shown) > WIDE else "table"
    yield rf"\begin{{{environment}}}"
    yield r"\centering\small"
    marks = ["Best values are bold."] * bool(table.marks) + ["Second best values are underlined."] * bool(table.seconds)
    title = table.title if table.title.endswith((".", "?")) else f"{table.title}."
    yield rf"\caption{{{escaped(' '.join([title, *marks, *table.notes]))}}}"
    yield rf"\label{{tab:{_name(table.name)}}}"
    yield rf"\begin{{tabular}}{{{'l' * len(table.labels)}{'r' * len(shown)}}}"
    yield r"\toprule"
    yield _line([*map(escaped, table.labels), *(escaped(table.columns[c].heading) for c in shown)])
    for r in range(len(table.rows)):
        if r == 0 or (table.grouped and table.starts_group(r)):
            yield r"\midrule"
        cells = []
        for c in shown:
            text = _number(table.text(r, c))
            command = r"\textbf" if (r, c) in table.marks else r"\underline" if (r, c) in table.seconds else None
            cells.append(text if command is None else f"{command}{{{text}}}")
        yield _line([*map(escaped, table.shown_labels(r)), *cells])
    yield r"\bottomrule"
    yield r"\end{tabular}"
    yield rf"\end{{{environment}}}"


def _line(cells: list[str]) -> str:
    return " & ".join(cells) + r" \\"


def _number(text: str) -> str:
    """Signs are those of mathematics; digits stay text, which can be bold."""
    return text.replace("-", "$-$").replace("+", "$+$").replace("±", r"$\pm$").replace("[", "{[}").replace("]", "{]}")


def _name(name: str) -> str:
    """A label may have letters, digits and hyphens."""
    return "".join(character if character.isascii() and character.isalnum() else "-" for character in name)
