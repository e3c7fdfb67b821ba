"""Where pages point to: addresses of the server, or files that lie beside each other in a bundle."""

from __future__ import annotations

from collections.abc import Mapping
from urllib.parse import quote, urlencode

from wasp_cli.notebook.cells import ListedCell
from wasp_cli.report.address import cell_address
from wasp_cli.store.layout import slug


class Links:
    """Addresses of the server."""

    live = True

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

    def cell(self, ref: str) -> str:
        """Return a cell: by its label where that is its alone, else by its key."""
        return cell_address(ref).replace(" ", "%20")

    def episode(self, ref: str, number: int, step: int | None = None) -> str:
        """Return an episode, or a decision of it."""
        return cell_address(ref, number, step).replace(" ", "%20")

    def step(self, ref: str, number: int) -> str:
        """Return where the explanation of a decision is asked for."""
        return f"{self.episode(ref, number)}/explain"

    def film(self, key: str, number: int, kind: str) -> str:
        """Return where a film is asked for; its frames stand below."""
        return f"/film/{key}/{number}/{kind}"

    def beside(self, a: str, b: str, **more: object) -> str:
        """Return two cells beside each other."""
        return f"/compare/cells?{urlencode({'a': a, 'b': b, **more})}"


class BundleLinks(Links):
    """Files of a folder, which work from anywhere."""

    live = False

    def __init__(self, cells: dict[str, ListedCell], episodes: dict[str, set[int]], reports: Mapping[str, str]) -> None:
        """Take what the bundle has: cells by key, of each the episodes, and where the pages of reports are."""
        self._cells, self._episodes, self._reports = cells, episodes, reports

    def static(self, name: str) -> str:
        return name

    def home(self) -> str:
        return "index.html"

    def cells(self) -> str:
        return "cells.html"

    def report(self, file: str) -> str:
        return quote(self._reports.get(file, ""))

    def run(self, run_id: str, more: str = "") -> str:
        return "index.html"

    def cell(self, ref: str) -> str:
        return f"cell-{self._name(ref)}.html" if ref in self._cells else "cells.html"

    def episode(self, ref: str, number: int, step: int | None = None) -> str:
        if not self.has(ref, number):
            return self.cell(ref)
        return f"episode-{self._name(ref)}-{number}.html" + ("" if step is None else f"?step={step}")

    def has(self, ref: str, number: int) -> bool:
        """Return whether an episode has a page."""
        return number in self._episodes.get(ref, ())

    def step(self, ref: str, number: int) -> str:
        return ""

    def film(self, key: str, number: int, kind: str) -> str:
        return f"films/{key}-{number}"

    def beside(self, a: str, b: str, **more: object) -> str:
        return self.cell(b)

    def _name(self, key: str) -> str:
        return slug(f"{self._cells[key].label}-{key[:8]}").replace("=", "-").replace("+", "-")
