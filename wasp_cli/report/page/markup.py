"""HTML that cannot be broken by what it shows: text is escaped unless it is markup already."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def escaped(value: object) -> Markup:
    """A value as HTML; markup stays as it is."""
    return value if isinstance(value, Markup) else Markup(html.escape(str(value)))


def joined(parts: Iterable[object], between: str = "") -> Markup:
    """Values one after the other."""
    return Markup(between.join(escaped(part) for part in parts))


def element(name: str, /, *children: object, **attributes: object) -> Markup:
    """`<name attributes>children</name>`; `class_` is `class`, other underscores are hyphens; None and False leave an attribute out."""
    text = "".join(_attribute(key, value) for key, value in attributes.items() if value is not None and value is not False)
    if name in ("img", "input", "meta", "br", "line", "rect", "polyline", "circle"):
        return Markup(f"<{name}{text}>" if name in ("img", "input", "meta", "br") else f"<{name}{text}/>")
    return Markup(f"<{name}{text}>{joined(children)}</{name}>")


def _attribute(key: str, value: object) -> str:
    name = key.rstrip("_").replace("_", "-") if key != "viewBox" else key
    return f" {name}" if value is True else f' {name}="{html.escape(str(value))}"'


def rows_table(headings: Sequence[str], rows: Iterable[Sequence[object]], name: str) -> Markup:
    """A table of texts, in a box of its own that scrolls where it is too wide."""
    head = element("tr", *(element("th", heading, scope="col") for heading in headings))
    body = [element("tr", *(element("td", cell) for cell in row)) for row in rows]
    table = element("table", element("thead", head), element("tbody", *body), class_=f"plain {name}")
    return element("div", table, class_="scroll")


def data_uri(data: bytes, mime: str) -> str:
    """Bytes as an address that needs no network."""
    return f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"


def list_of(lines: Iterable[object]) -> Markup:
    """A bulleted list; nothing without lines."""
    items = [element("li", line) for line in lines]
    return element("ul", *items) if items else Markup("")
