"""The results folder behind the pages: its cells and their numbers, where links lead, templates,
which escape.

Names of cells come at once, from plans and manifests; numbers are read in the background.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import numpy as np

from wasp_cli.cells.cell import RecordedCell, stored_cells
from wasp_cli.cells.read import read_cells
from wasp_cli.cells.runs import recorded_runs
from wasp_cli.cells.table import EPISODE, CellTable
from wasp_cli.errors import ArtifactError, StoreError, UnknownName, UsageError, described
from wasp_cli.metrics.severity import AUTO
from wasp_cli.report.notes import Note, invalid, notes_of
from wasp_cli.report.render import TEMPLATES, cell_address, templates
from wasp_cli.report.tables import who_title
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.find import KIND, FoundCell, find_cell
from wasp_cli.store.layout import Layout, is_key, slug
from wasp_cli.store.named import matching
from wasp_cli.store.tables import cell_file
from wasp_cli.view.films import Films

FRESH = 2.0  # seconds for which a listing counts as new: a live store grows
TOGETHER = 250  # cells whose numbers are read in one go, before the page is told of them
REPORT = "report.html"
COLUMNS = PAPER_COLUMNS  # what the table shows of a cell, as reports print it


@dataclass(frozen=True)
class Shown:
    """The numbers of a cell, or why there are none."""

    numbers: CellTable | None  # of this cell alone
    episodes: int = 0
    reason: str = ""  # why there are none, or what is odd about them
    damaged: bool = False

    @property
    def texts(self) -> list[str]:
        """Its numbers as reports print them, one for each of COLUMNS; nothing without numbers."""
        if self.numbers is None:
            return []
        return [column.number(float(self.numbers.pooled(column.key)[0])) for column in COLUMNS]

    @property
    def row(self) -> list[str]:
        """The line of the table of cells: the number of episodes, one text for each of COLUMNS,
        what is odd.
        """
        return [
            str(self.episodes or ""),
            *(self.texts or [""] * len(COLUMNS)),
            "damaged" if self.damaged else self.reason,
        ]

    def without(self, invalid: Collection[int | None]) -> Shown:
        """Return the cell without the episodes that are marked as invalid; None stands for the
        whole cell.
        """
        if self.numbers is None:
            return self
        if None in invalid:
            return replace(self, numbers=None, reason="marked as invalid")
        out = [episode for episode in invalid if episode is not None]
        numbers = self.numbers.with_episodes(~np.isin(self.numbers.episodes(EPISODE), out))
        if not len(numbers):
            return Shown(None, 0, "all episodes are marked as invalid")
        return Shown(numbers, int(numbers.counts[0]), "has invalid episodes")


class Cells:
    """What a folder has; safe to ask from several threads."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self._listed: list[RecordedCell] = []
        self._labels: Counter[str] = Counter()
        self._problems: list[str] = []
        self._at = -FRESH
        # as they are stored: what is marked as invalid is in them
        self._read: dict[str, Shown] = {}
        self._lock = threading.RLock()
        self._reader: threading.Thread | None = None

    def listed(self) -> list[RecordedCell]:
        """Return every cell: those of the last run of each spec, then what else is in the
        store; each key once.
        """
        with self._lock:
            if time.monotonic() - self._at > FRESH:
                self._listed, self._problems = _listed(self.layout)
                self._labels = Counter(cell.label for cell in self._listed)
                self._at = time.monotonic()
            return self._listed

    def ref(self, cell: RecordedCell) -> str:
        self.listed()
        return cell.label if self._labels[cell.label] == 1 else cell.key

    @property
    def problems(self) -> list[str]:
        self.listed()
        return self._problems

    def numbers(self) -> tuple[Mapping[str, Shown], int]:
        """Return what is known by key, and how many cells are yet to be read; reading goes on
        in the background.
        """
        left = [cell for cell in self.listed() if cell.key not in self._read]
        with self._lock:
            if left and (self._reader is None or not self._reader.is_alive()):
                self._reader = threading.Thread(
                    target=self._read_all, args=(left,), daemon=True, name="cells"
                )
                self._reader.start()
        return self._without_invalid(self._read), len(left)

    def wait(self) -> Mapping[str, Shown]:
        while self.numbers()[1]:
            reader = self._reader
            if reader is not None:
                reader.join()
        return self.numbers()[0]

    def refresh(self) -> None:
        """Read the cells without rows again: what was absent may be there by now."""
        with self._lock:
            self._read = {
                key: shown for key, shown in self._read.items() if shown.numbers is not None
            }

    def one(self, cell: RecordedCell) -> Shown:
        return self._without_invalid(self._shown([cell]))[cell.key]

    def _read_all(self, cells: Sequence[RecordedCell]) -> None:
        for first in range(0, len(cells), TOGETHER):
            part = cells[first : first + TOGETHER]
            try:
                shown = self._shown(part)
            except Exception as error:
                # whatever is wrong with one of them, the page must not wait for ever
                shown = {
                    cell.key: Shown(None, 0, described(error)[:200], damaged=True) for cell in part
                }
            with self._lock:
                self._read = {**self._read, **shown}

    def _shown(self, cells: Sequence[RecordedCell]) -> dict[str, Shown]:
        """Read single cells; what is wrong with one is said of that one."""
        found = read_cells(self.layout, cells)
        shown = {gap.key: Shown(None, 0, gap.reason, gap.damaged) for gap in found.missing}
        for place, cell in enumerate(found.table):
            shown[cell.key] = Shown(found.table.choose([place]), int(found.table.counts[place]))
        return shown

    def _without_invalid(self, shown: Mapping[str, Shown]) -> Mapping[str, Shown]:
        marked: dict[str, set[int | None]] = {}
        with suppress(StoreError):  # the first page says that notes do not read
            for key, episode in invalid(notes_of(self.layout)):
                if key in shown:
                    marked.setdefault(key, set()).add(episode)
        return {**shown, **{key: shown[key].without(episodes) for key, episodes in marked.items()}}

    def find(self, text: str) -> tuple[list[RecordedCell], FoundCell | None]:
        """Return the listed cells that a label or the beginning of a key names, and the
        artifact where it is only one.
        """
        cells = matching(self.listed(), text)
        if len(cells) > 1:
            # Of several versions of one cell the one of the newest run of its spec is meant; the
            # page names the others.
            planned = [cell for cell in cells if cell.spec is not None]
            if len({cell.key for cell in planned}) != 1:
                return cells, None
            cells = planned[:1]
        if cells:
            key = cells[0].key
            # Of a cell that is planned and not computed nothing is known.
            manifest = (
                read_manifest(self.layout, KIND, key)
                if os.path.lexists(self.layout.artifact(KIND, key))
                else {}
            )
            return cells, FoundCell(
                self.layout.within(cell_file(self.layout.artifact(KIND, key))), key, manifest
            )
        # What a person typed is compared with keys and labels, and never becomes a path: only what
        # begins with a key may be a file.
        typed = " ".join(text.split())
        if typed and not is_key(typed):
            raise UnknownName("cell", typed, [cell.label for cell in self.listed()])
        return [], find_cell(self.layout, typed, stored_keys(self.layout, KIND))


def _listed(layout: Layout) -> tuple[list[RecordedCell], list[str]]:
    cells: dict[str, RecordedCell] = {}
    problems: list[str] = []
    try:
        for run in reversed(recorded_runs(layout).runs.values()):
            try:
                cells = {**{cell.key: cell for cell in run.cells}, **cells}
            except ArtifactError as error:
                problems.append(error.message)
    except StoreError as error:
        problems.append(error.message)
    with suppress(StoreError):
        others = stored_keys(layout, KIND) - cells.keys()
        stored = {cell.key: cell for cell in stored_cells(layout)} if others else {}
        cells |= {
            key: stored[key]
            for key in sorted(others & stored.keys(), key=lambda key: (stored[key].label, key))
        }
        problems += [
            f"the manifest of evaluate/{key} is damaged, or of another version"
            for key in sorted(others - stored.keys())
        ]
    return list(cells.values()), problems


def words(cell: RecordedCell) -> tuple[str, ...]:
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
        return f"/static/{name}" if self.live else name

    def report(self, file: str) -> str:
        """Return a page of a report; the server has none: it may come from elsewhere."""
        return quote(self._reports.get(file, ""))

    def shown_report(self, spec: str, layout: Layout) -> str:
        return (
            f"/report/{quote(spec, '')}"
            if self.live and (layout.reports(spec) / REPORT).is_file()
            else ""
        )

    def row(self, task: str, method: str) -> str:
        return f"{self.cells}?{urlencode({'task': task, 'method': method})}"

    def run(self, run_id: str, more: str = "") -> str:
        return f"/run/{quote(run_id, '')}{more}" if self.live else self.home

    def cell(self, cell: RecordedCell) -> str:
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
        return f"/film/{cell.key}/{number}/{kind}" if self.live else f"films/{cell.key}-{number}"

    def beside(self, a: str, b: str, **more: object) -> str:
        return f"/compare/cells?{urlencode({'a': a, 'b': b, **more})}" if self.live else self.cells


def _name(cell: RecordedCell) -> str:
    return slug(f"{cell.label}-{cell.key[:8]}").replace("=", "-").replace("+", "-")


@dataclass(eq=False)
class Site:
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
