"""A results folder as pages: its cells and films, where links lead (to the server, or files of a bundle), and templates, which escape."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

from wasp_cli.errors import StoreError, UsageError
from wasp_cli.notebook.cells import ListedCell
from wasp_cli.report.address import cell_address
from wasp_cli.report.notes import Note, notes_of
from wasp_cli.report.render import templates
from wasp_cli.store.find import FoundCell
from wasp_cli.store.layout import Layout, slug
from wasp_cli.view.cells import Cells
from wasp_cli.view.films import Films


class Links:
    """Addresses of the server."""

    live = True

    def __init__(self, cells: Cells) -> None:
        self._known = cells

    def static(self, name: str) -> str:
        """Return a file of the page."""
        return f"/static/{name}"

    def home(self) -> str:
        """Return the first page."""
        return "/"

    def cells(self) -> str:
        """Return the table of cells."""
        return "/cells"

    def report(self, file: str) -> str:
        """Return a page of a report; nothing here: it may come from elsewhere, and is not served."""
        return ""

    def run(self, run_id: str, more: str = "") -> str:
        """Return a run, or something of it."""
        return f"/run/{quote(run_id, '')}{more}"

    def cell(self, cell: ListedCell) -> str:
        """Return a cell."""
        return cell_address(self._known.ref(cell)).replace(" ", "%20")

    def episode(self, cell: ListedCell, number: int) -> str:
        """Return an episode; nothing where it has no page."""
        return cell_address(self._known.ref(cell), number).replace(" ", "%20")

    def film(self, cell: ListedCell, number: int, kind: str) -> str:
        """Return where a film is asked for; its frames stand below."""
        return f"/film/{cell.key}/{number}/{kind}"

    def beside(self, a: str, b: str, **more: object) -> str:
        """Return two cells beside each other, as an address names them."""
        return f"/compare/cells?{urlencode({'a': a, 'b': b, **more})}"


class BundleLinks(Links):
    """Files of a folder, which work from anywhere; there are none of runs, and none of two cells beside each other."""

    live = False

    def __init__(self, cells: Cells, episodes: Mapping[str, Collection[int]], reports: Mapping[str, str]) -> None:
        super().__init__(cells)
        self._episodes, self._reports = episodes, reports

    def static(self, name: str) -> str:
        return name

    def home(self) -> str:
        return "index.html"

    def cells(self) -> str:
        return "cells.html"

    def report(self, file: str) -> str:
        return quote(self._reports.get(file, ""))

    def run(self, run_id: str, more: str = "") -> str:
        return self.home()

    def cell(self, cell: ListedCell) -> str:
        return f"cell-{_name(cell)}.html" if cell.key in self._episodes else self.cells()

    def episode(self, cell: ListedCell, number: int) -> str:
        return f"episode-{_name(cell)}-{number}.html" if number in self._episodes.get(cell.key, ()) else ""

    def film(self, cell: ListedCell, number: int, kind: str) -> str:
        return f"films/{cell.key}-{number}"

    def beside(self, a: str, b: str, **more: object) -> str:
        return self.cells()


def _name(cell: ListedCell) -> str:
    return slug(f"{cell.label}-{cell.key[:8]}").replace("=", "-").replace("+", "-")


@dataclass(eq=False)
class Site:
    """A results folder as pages."""

    layout: Layout
    cells: Cells
    links: Links
    films: Films | None = None  # None in a bundle, whose films are files

    @property
    def name(self) -> str:
        """Return the name of the folder; in a bundle, which is for others, without the way to it."""
        return str(self.layout.root) if self.links.live else self.layout.root.absolute().name

    def render(self, template: str, title: str, **values: Any) -> str:
        """Fill a template of a whole page, or of a part of one."""
        # The timeline is the report's own.
        environment = templates("wasp_cli.view", "wasp_cli.report.page")
        return environment.get_template(template).render(site=self, links=self.links, title=title, **values)

    def one(self, text: str) -> tuple[ListedCell, FoundCell]:
        """Return the one cell that an address names; a WaspError where it names none, several, or a damaged one."""
        listed, artifact = self.cells.find(text)
        if artifact is None:
            keys = ", ".join(cell.key for cell in listed[:12])
            raise UsageError(f"'{text}' names {len(listed)} cells", f"name one by its key: {keys}")
        if not listed:
            raise UsageError(f"'{text}' is in no plan, and its manifest says of no cell")
        return listed[0], artifact

    def notes(self) -> list[Note]:
        """Return all notes; none where they do not read, which the first page says."""
        try:
            return notes_of(self.layout)
        except StoreError:
            return []


def site_of(folder: Path, *, films: bool = True) -> Site:
    """Return a results folder as pages.

    Raises:
        StoreError: the folder has no results, or links in it.
    """
    layout = Layout(folder)
    layout.require_own_folders()
    if not layout.store.is_dir() and not layout.runs.is_dir():
        raise StoreError(f"no results in '{folder}': it has neither runs nor a store", "wasp run SPEC --results DIR writes there")
    cells = Cells(layout)
    return Site(layout, cells, Links(cells), Films(layout) if films else None)
