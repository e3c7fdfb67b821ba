"""Tables and pages as HTML, and text that somebody else wrote in Markdown: nothing of it becomes markup."""

from html.parser import HTMLParser
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.report.render import html, markdown_text, rendered
from wasp_cli.report.summary import Value
from wasp_cli.report.tables.table import Column, Row, Table

ANY = st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=20)


class Reader(HTMLParser):
    """The elements of a fragment; every end tag belongs to the last open one."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, Any]]] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)
        self.found.append((tag, dict(attrs)))
        self.texts.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("td", "th", "li", "caption", "strong", "u"):
            self.texts[-1] += data

    def all(self, tag: str) -> list[dict[str, Any]]:
        return [attributes for name, attributes in self.found if name == tag]


@given(title=ANY, label=ANY, heading=ANY, note=ANY)
def test_all_text_is_escaped(title: str, label: str, heading: str, note: str) -> None:
    reader = Reader(html(Table(title, title, (heading,), (Column("k", heading),), (Row((label,), (Value(1.0),)),), (note,), (note,))))
    assert [name for name, _ in reader.found] == [
        "figure", "table", "caption", "thead", "tr", "th", "th", "tbody", "tr", "th", "td", "ul", "li", "ul", "li",
    ]  # fmt: skip
    assert reader.all("figure") == [{"class": "table", "id": title}]
    assert (reader.texts[2], reader.texts[5], reader.texts[9], reader.texts[12]) == (title, heading, label, note)


LANE = {"height": 8, "levels": [], "curves": [], "marks": []}


@given(ANY)
def test_a_template_escapes_text_and_attributes_and_markup_only_once(name: str) -> None:
    page = rendered("timeline.html", lanes=[{**LANE, "name": name}], decisions=3)
    reader = Reader(page)
    assert [tag for tag, _ in reader.found] == ["div", "div", "span", "svg", "line"]
    assert reader.all("svg")[0]["aria-label"] == f"{name} over 3 decisions"
    assert page.count("&amp;amp;") == 2 * name.count("&amp;")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("the robot starts within a hazard", "the robot starts within a hazard"),
        ("<script>x()</script>", "&lt;script>x()&lt;/script>"),
        ("a &lt; b", "a &amp;lt; b"),
        ("![p](http://there/p.png)", r"!\[p\](http://there/p.png)"),
        (r"\[a](b)", r"\\\[a\](b)"),
        ("Preset `cpu`", "Preset `cpu`"),
    ],
)
def test_it_stays_text(text: str, expected: str) -> None:
    assert markdown_text(text) == expected
