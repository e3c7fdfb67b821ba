from __future__ import annotations

from html.parser import HTMLParser
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from jinja2 import UndefinedError

from wasp_cli.report.render import data_uri, html, rendered
from wasp_cli.report.stats.frame import Frame
from wasp_cli.report.stats.summary import Interval, Value
from wasp_cli.report.tables.main import main_table
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


def test_numbers_to_sort_by() -> None:
    values = (Value(1 / 3, interval=Interval(-0.25, 0.5, "training", 3)), Value(None))
    reader = Reader(html(Table("t", "T", ("Task",), (Column("a", "A", "up", digits=1), Column("b", "B")), (Row(("x",), values),))))
    first, second = reader.all("td")
    assert first == {
        "class": "number", "data-value": "0.333333333333", "data-low": "-0.25", "data-high": "0.5", "title": "range of three trainings",
    }  # fmt: skip
    assert second == {"class": "number", "data-value": ""}
    assert "0.3 [-0.2, 0.5]" in reader.texts
    assert reader.all("th")[1:] == [
        {"scope": "col", "class": "number", "data-better": "up"}, {"scope": "col", "class": "number"}, {"scope": "row"},
    ]  # fmt: skip


def test_marks_and_groups(frame: Frame) -> None:
    table = main_table(frame)
    reader = Reader(html(table))
    assert len(reader.all("strong")) == len(table.marks) > 0
    assert len(reader.all("u")) == len(table.seconds) > 0
    assert len(reader.all("tbody")) == 1
    assert [row.get("class") for row in reader.all("th") if row["scope"] == "row"][::2] == [
        None,
        "again",
        "again",
        "again",
        "again",
        "again",
    ]
    assert len(reader.all("li")) == len(table.notes) + len(table.meanings)


def test_a_group_is_a_body() -> None:
    rows = tuple(Row((task, method), ()) for task in "ab" for method in "xyz")
    assert len(Reader(html(Table("t", "T", ("Task", "Method"), (), rows))).all("tbody")) == 2
    assert len(Reader(html(Table("t", "T", ("Task", "Method"), (), rows, grouped=False))).all("tbody")) == 1
    assert Reader(html(Table("t", "T", ("Task", "Method"), (), ()))).all("tbody") == []


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


def test_a_name_that_a_template_is_not_given_is_an_error() -> None:
    with pytest.raises(UndefinedError, match="decisions"):
        rendered("timeline.html", lanes=[{**LANE, "name": "x"}])


def test_an_address_that_needs_no_network() -> None:
    assert data_uri(b"\x00\x01", "image/png") == "data:image/png;base64,AAE="
