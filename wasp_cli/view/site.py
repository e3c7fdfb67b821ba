"""The results folder behind the pages: where links lead, templates, which escape, and its cells and
notes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.metrics.severity import AUTO
from wasp_cli.report.notes import Note, notes_of
from wasp_cli.report.render import TEMPLATES, cell_address, templates
from wasp_cli.report.tables import who_title
from wasp_cli.store.find import FoundCell
from wasp_cli.store.layout import Layout, slug
from wasp_cli.view.cells import Cells
from wasp_cli.view.films import Films

REPORT = "report.html"


def words(cell: RecordedCell) -> tuple[str, ...]:
    """Return the words of a cell in the table of cells: task, method, operator, severity, seed."""
    severity = "" if cell.value is None else f"{cell.value:g}"
    if cell.chosen and cell.value is None:
        severity = AUTO
    if severity and cell.severity:
        severity += f" ({cell.severity})"
    return cell.task, who_title(cell.method, cell.variant), cell.operator, severity, str(cell.seed)


class Links:
    """Addresses of the server; with `episodes` (numbers by key of a cell) the files of a
    bundle, which has no runs and no comparisons.
    """

    def __init__(
        self,
        cells: Cells,
        episodes: Mapping[str, Collection[int]] | None = None,
        reports: Mapping[str, str] | None = None,
    ) -> None:
        self._known = cells
        self._episodes = episodes or {}
        self._reports = reports or {}
        self.live = episodes is None
        self.home, self.cells = ("/", "/cells") if self.live else ("index.html", "cells.html")

    def static(self, name: str) -> str:
        """Return a style sheet or a script."""
        return f"/static/{name}" if self.live else name

    def report(self, file: str) -> str:
        """Return a page of a report; the server has none: it may come from elsewhere."""
        return quote(self._reports.get(file, ""))

    def shown_report(self, spec: str, layout: Layout) -> str:
        """Return the report of a spec; nothing where it has none, and in a bundle."""
        return (
            f"/report/{quote(spec, '')}"
            if self.live and (layout.reports(spec) / REPORT).is_file()
            else ""
        )

    def row(self, task: str, method: str) -> str:
        """Return the table of cells with those of one row of the main table."""
        return f"{self.cells}?{urlencode({'task': task, 'method': method})}"

    def run(self, run_id: str, more: str = "") -> str:
        """Return the page of a run, or a part of it; in a bundle the first page."""
        return f"/run/{quote(run_id, '')}{more}" if self.live else self.home

    def cell(self, cell: RecordedCell) -> str:
        """Return the page of a cell; in a bundle the table of cells where it has no page."""
        if self.live:
            return cell_address(self._known.ref(cell)).replace(" ", "%20")
        return f"cell-{_name(cell)}.html" if cell.key in self._episodes else self.cells

    def episode(self, cell: RecordedCell, number: int) -> str:
        """Return an episode; nothing where it has no page."""
        if self.live:
            return cell_address(self._known.ref(cell), number).replace(" ", "%20")
        return (
            f"episode-{_name(cell)}-{number}.html"
            if number in self._episodes.get(cell.key, ())
            else ""
        )

    def film(self, cell: RecordedCell, number: int, kind: str) -> str:
        """Return the film of an episode; its folder of frames in a bundle."""
        return f"/film/{cell.key}/{number}/{kind}" if self.live else f"films/{cell.key}-{number}"

    def beside(self, a: str, b: str, **more: object) -> str:
        """Return two cells beside each other; in a bundle the table of cells."""
        return f"/compare/cells?{urlencode({'a': a, 'b': b, **more})}" if self.live else self.cells


def _name(cell: RecordedCell) -> str:
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
        """Return the name of the folder; in a bundle, which is for others, without the way to
        it.
        """
        return str(self.layout.root) if self.links.live else self.layout.root.absolute().name

    def render(self, template: str, title: str, **values: Any) -> str:
        """Return a page made of a template, with `site`, `links` and the values."""
        # the timeline is the report's own
        environment = templates(("wasp_cli.view", "templates"), TEMPLATES)
        return environment.get_template(template).render(
            site=self, links=self.links, title=title, **values
        )

    def one(self, text: str) -> tuple[RecordedCell, FoundCell]:
        """Return the one cell that an address names; a UsageError where it names none or
        several.
        """
        listed, artifact = self.cells.find(text)
        if artifact is None:
            keys = ", ".join(cell.key for cell in listed[:12])
            raise UsageError(f"'{text}' names {len(listed)} cells", f"name one by its key: {keys}")
        if not listed:
            raise UsageError(f"'{text}' is in no plan, and its manifest says of no cell")
        return listed[0], artifact

    def notes(self) -> list[Note]:
        """Return all notes; none where they do not read, which the first page says."""
        with suppress(StoreError):
            return notes_of(self.layout)
        return []


def site_of(folder: Path, *, films: bool = True) -> Site:
    """Return a results folder as pages; a StoreError where it has no results, or links in it."""
    layout = Layout(folder)
    layout.require_own_folders()
    if not layout.store.is_dir() and not layout.runs.is_dir():
        raise StoreError(
            f"no results in '{folder}': it has neither runs nor a store",
            "wasp run SPEC --results DIR writes there",
        )
    cells = Cells(layout)
    return Site(layout, cells, Links(cells), Films(layout) if films else None)
