"""Lines that were written for a terminal, as HTML of the same words: bold, dim and the colours of gates become classes."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING

from rich.text import Text

if TYPE_CHECKING:
    from markupsafe import Markup

CLASSES = {"bold": "b", "dim": "dim", "yellow": "safety", "cyan": "task", "magenta": "method", "red": "bad", "green": "good"}


def as_html(lines: Iterable[Text]) -> Markup:
    """Return lines as the content of a `<pre>`, everything escaped."""
    from markupsafe import Markup, escape

    return Markup("\n").join(Markup("").join(_piece(escape(text), style) for text, style in _pieces(line)) for line in lines)


def _piece(text: Markup, style: str) -> Markup:
    from markupsafe import Markup

    return Markup('<span class="{}">{}</span>').format(style, text) if style else text


def _pieces(line: Text) -> Iterable[tuple[str, str]]:
    edges = sorted({0, len(line.plain), *(edge for span in line.spans for edge in (span.start, span.end) if 0 <= edge <= len(line.plain))})
    for first, last in pairwise(edges):
        words = str(line.style).split()
        for span in line.spans:
            if span.start <= first and last <= span.end:
                words += str(span.style).split()
        classes: list[str] = []
        for place, word in enumerate(words):
            name = CLASSES.get(word)
            if name is None:
                continue
            classes = [each for each in classes if each != name]
            if place == 0 or words[place - 1] != "not":
                classes.append(name)
        yield line.plain[first:last], " ".join(classes)
