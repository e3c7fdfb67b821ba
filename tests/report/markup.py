"""The elements of pages, for tests that look at what a reader's browser makes of them."""

from html.parser import HTMLParser

VOID = {"meta", "img", "input", "br"}


class Outline(HTMLParser):
    """The elements of a page or a part of one; every end tag belongs to the last open one."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.found.append((tag, dict(attrs)))
        self.texts.append("")
        assert len(self.found[-1][1]) == len(attrs), "an attribute is there twice"

    def handle_endtag(self, tag: str) -> None:
        assert tag not in VOID
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("td", "th", "li", "caption", "strong", "u"):
            self.texts[-1] += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.found if name == tag]

    def values(self, *names: str) -> list[str]:
        """What attributes of these names say, of all elements."""
        return [
            value or ""
            for _, attributes in self.found
            for name, value in attributes.items()
            if name in names
        ]
