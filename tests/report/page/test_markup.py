"""Text never becomes markup, whatever it says."""

from __future__ import annotations

from html.parser import HTMLParser

from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.report.page.markup import Markup, data_uri, element, escaped, joined, list_of, rows_table

TEXT = st.text(st.characters(exclude_characters="\r\0", exclude_categories=["Cs"]))


class Reader(HTMLParser):
    """What a browser would see."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


@given(TEXT, TEXT)
def test_what_is_shown_is_what_was_said(text: str, label: str) -> None:
    seen = Reader(element("p", text, title=label, data_x=label))
    assert seen.tags == [("p", {"title": label, "data-x": label})]
    assert seen.text == text


@given(TEXT)
def test_markup_is_escaped_once(text: str) -> None:
    once = escaped(text)
    assert escaped(once) is once
    assert Reader(element("div", once)).text == text


@given(st.lists(st.lists(TEXT, min_size=2, max_size=2), max_size=3))
def test_tables_keep_their_cells(rows: list[list[str]]) -> None:
    seen = Reader(rows_table(("a<b", "c"), rows, "x"))
    assert [tag for tag, _ in seen.tags].count("td") == 2 * len(rows)
    assert seen.text == "a<bc" + "".join(cell for row in rows for cell in row)


def test_attributes() -> None:
    assert element("input", type="range", disabled=True, hidden=False, name=None) == '<input type="range" disabled>'
    assert element("svg", viewBox="0 0 1 1", class_="x") == '<svg viewBox="0 0 1 1" class="x"></svg>'
    assert element("line", x1=1) == '<line x1="1"/>'
    assert joined(["<", Markup("<br>")], ", ") == "&lt;, <br>"
    assert list_of([]) == ""
    assert list_of(["a"]) == "<ul><li>a</li></ul>"
    assert data_uri(b"\0\1", "image/png") == "data:image/png;base64,AAE="
