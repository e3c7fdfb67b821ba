"""What every page has: the folder, its cells and films, where links go, and the templates, which escape all text."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from wasp_cli.errors import StoreError, UsageError
from wasp_cli.notebook.cells import ListedCell
from wasp_cli.report.notes import Note, notes_of
from wasp_cli.report.render.files import data_uri
from wasp_cli.report.render.text import plain
from wasp_cli.report.tables.titles import who_title
from wasp_cli.store.find import FoundCell
from wasp_cli.store.layout import Layout
from wasp_cli.view.cells import Cells
from wasp_cli.view.links import Links

if TYPE_CHECKING:
    from jinja2 import Environment

    from wasp_cli.view.films import Films


@dataclass(eq=False)
class Site:
    """A results folder as pages."""

    layout: Layout
    cells: Cells
    links: Links
    films: Films | None = None
    """None in a bundle, whose films are files."""

    @property
    def name(self) -> str:
        """Return the name of the folder; in a bundle, which is for others, without the way to it."""
        return str(self.layout.root) if self.links.live else self.layout.root.absolute().name

    def render(self, template: str, title: str, **values: Any) -> str:
        """Fill a template of a whole page, or of a part of one."""
        return _environment().get_template(template).render(site=self, links=self.links, title=title, **values)

    def ref(self, cell: ListedCell) -> str:
        """Return how a cell is named in addresses: by its label where that is its alone."""
        if not self.links.live:
            return cell.key
        counted = self._labels()
        return cell.label if counted[cell.label] == 1 else cell.key

    def _labels(self) -> Counter[str]:
        listed = self.cells.listed()
        if getattr(self, "_counted_of", None) is not listed:
            self._counted: Counter[str] = Counter(cell.label for cell in listed)
            self._counted_of = listed
        return self._counted

    def one(self, text: str) -> tuple[ListedCell, FoundCell]:
        """Return the one cell that an address names.

        Raises:
            UsageError: it names several.
            WaspError: it names none, or what it names is damaged.
        """
        listed, found = self.cells.find(text)
        if found is None:
            keys = ", ".join(cell.key for cell in listed[:12])
            raise UsageError(f"'{text}' names {len(listed)} cells", f"name one by its key: {keys}")
        if not listed:
            raise UsageError(f"'{text}' is in no plan, and its manifest says of no cell")
        return listed[0], found

    def notes(self) -> list[Note]:
        """Return all notes; none where they do not read, which the first page says."""
        try:
            return notes_of(self.layout)
        except StoreError:
            return []


@cache
def _environment() -> Environment:
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    environment = Environment(
        # The timeline is the report's own.
        loader=ChoiceLoader([PackageLoader("wasp_cli.view"), PackageLoader("wasp_cli.report.page")]),
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.globals |= {"plain": plain, "data_uri": data_uri, "who_title": who_title}
    return environment
