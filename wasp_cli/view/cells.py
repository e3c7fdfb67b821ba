"""The cells of a results folder and their numbers, for pages.

Names of cells come at once, from plans and manifests. Numbers are read in the background.

    known = cells.known()       what is read by now
    known.lines[cell.key]       its numbers, as texts
    known.frame(cells)          some of them, for a table of a report
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from wasp_cli.cells.cell import RecordedCell, stored_cells
from wasp_cli.cells.read import CellsRead, Missing, read_cells, table_of
from wasp_cli.cells.runs import recorded_runs
from wasp_cli.cells.table import CellTable
from wasp_cli.errors import ArtifactError, StoreError, UnknownName, described
from wasp_cli.report.notes import invalid, notes_of, without_invalid
from wasp_cli.report.stats import Frame
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.find import KIND, FoundCell, find_cell
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.named import matching
from wasp_cli.store.tables import cell_file

FRESH = 2.0  # seconds for which a listing counts as new: a live store grows
TOGETHER = 250  # cells whose numbers are read in one go, before the page is told of them
COLUMNS = PAPER_COLUMNS  # what the table shows of a cell, as reports print it


@dataclass(frozen=True, eq=False)
class Known:
    """What is read of the cells of a folder by now, without what is marked as invalid."""

    table: CellTable
    missing: Mapping[str, Missing]  # by key: the cells without numbers
    partial: frozenset[str]  # keys of the cells that have invalid episodes
    left: int  # cells that are yet to be read

    @cached_property
    def places(self) -> Mapping[str, int]:
        """By key, which cell of the table it is."""
        return {cell.key: place for place, cell in enumerate(self.table)}

    @cached_property
    def lines(self) -> Mapping[str, list[str]]:
        """By key, the line of the table of cells: the number of episodes, one text for each of
        COLUMNS, what is odd.
        """
        lines: dict[str, list[str]] = {}
        for key, gap in self.missing.items():
            lines[key] = ["", *[""] * len(COLUMNS), "damaged" if gap.damaged else gap.reason]
        pooled = [self.table.pooled(column.key).tolist() for column in COLUMNS]
        for key, place in self.places.items():
            texts = [
                column.number(numbers[place])
                for column, numbers in zip(COLUMNS, pooled, strict=True)
            ]
            odd = "has invalid episodes" if key in self.partial else ""
            lines[key] = [str(self.table.counts[place]), *texts, odd]
        return lines

    def cell(self, key: str) -> CellTable | None:
        """Return the table of one cell; None where it has no numbers."""
        place = self.places.get(key)
        return None if place is None else self.table.choose([place])

    def frame(self, cells: Sequence[RecordedCell]) -> Frame:
        """Return some of the cells, in that order, for the tables of a report."""
        places = [self.places[cell.key] for cell in cells if cell.key in self.places]
        others = [cell.key for cell in cells if cell.key not in self.places]
        missing = [self.missing[key] for key in others if key in self.missing]
        return Frame(self.table.choose(places), tuple(missing), tuple(cells))


class Cells:
    """What a folder has; safe to ask from several threads."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self._listed: list[RecordedCell] = []
        self._labels: Counter[str] = Counter()
        self._problems: list[str] = []
        self._at = -FRESH
        # as they are stored: what is marked as invalid is in them
        self._parts: list[CellsRead] = []
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
        """Return what an address calls a cell: its label; its key where several have the label."""
        self.listed()
        return cell.label if self._labels[cell.label] == 1 else cell.key

    @property
    def problems(self) -> list[str]:
        """What is wrong with the plans and manifests of the folder, a sentence each."""
        self.listed()
        return self._problems

    def known(self) -> Known:
        """Return what is read by now; reading goes on in the background."""
        parts = self._parts
        read = {cell.key for part in parts for cell in part.table}
        read.update(gap.key for part in parts for gap in part.missing)
        left = [cell for cell in self.listed() if cell.key not in read]
        with self._lock:
            if left and (self._reader is None or not self._reader.is_alive()):
                self._reader = threading.Thread(
                    target=self._read_all, args=(left,), daemon=True, name="cells"
                )
                self._reader.start()
        return self._without_invalid(parts, len(left))

    def wait(self, also: Iterable[RecordedCell] = ()) -> Known:
        """Return what is known of all listed cells, as soon as they are read; and of others, since
        the listing may be some seconds old.
        """
        known = self.known()
        while known.left:
            reader = self._reader
            if reader is not None:
                reader.join()
            known = self.known()
        unlisted = {cell.key: cell for cell in also}
        for key in (*known.places, *known.missing):
            unlisted.pop(key, None)
        if not unlisted:
            return known
        part = self._read(list(unlisted.values()))
        with self._lock:
            self._parts = [*self._parts, part]
        return self.known()

    def refresh(self) -> None:
        """Read the cells without rows again: what was absent may be there by now."""
        with self._lock:
            self._parts = [CellsRead(part.table, ()) for part in self._parts]

    def read(self, cells: Sequence[RecordedCell]) -> Known:
        """Read some cells now, listed or not."""
        return self._without_invalid([self._read(cells)], 0)

    def _read_all(self, cells: Sequence[RecordedCell]) -> None:
        for first in range(0, len(cells), TOGETHER):
            part = self._read(cells[first : first + TOGETHER])
            with self._lock:
                self._parts = [*self._parts, part]

    def _read(self, cells: Sequence[RecordedCell]) -> CellsRead:
        try:
            return read_cells(self.layout, cells)
        except Exception as error:
            # Whatever is wrong with one of them, the page must not wait for ever.
            why = described(error)[:200]
            gaps = [Missing(cell, why, cell.title, damaged=True) for cell in cells]
            return CellsRead(table_of([]), tuple(gaps))

    def _without_invalid(self, parts: Sequence[CellsRead], left: int) -> Known:
        """What was read, without the cells and episodes that somebody marked."""
        table = CellTable.joined([part.table for part in parts])
        missing = tuple(gap for part in parts for gap in part.missing)
        marked = {}
        with suppress(StoreError):  # the first page says that notes do not read
            marked = invalid(notes_of(self.layout))
        # Only what is marked is copied: a folder may have a million episodes.
        keys = {key for key, _ in marked}
        rest = Frame(table.where(lambda cell: cell.key in keys), missing)
        rest, _ = without_invalid(rest, marked)
        whole = table.where(lambda cell: cell.key not in keys)
        return Known(
            CellTable.joined([whole, rest.cells]),
            {gap.key: gap for gap in rest.missing},
            frozenset(keys),
            left,
        )

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
            folder = self.layout.artifact(KIND, key)
            manifest: Mapping[str, Any] = {}  # of a cell that is planned and not computed
            if os.path.lexists(folder):
                manifest = read_manifest(self.layout, KIND, key)
            return cells, FoundCell(self.layout.within(cell_file(folder)), key, manifest)
        # What a person typed is compared with keys and labels, and never becomes a path: only what
        # begins with a key may be a file.
        typed = " ".join(text.split())
        if typed and not is_key(typed):
            raise UnknownName("cell", typed, [cell.label for cell in self.listed()])
        return [], find_cell(self.layout, typed, stored_keys(self.layout, KIND))


def _listed(layout: Layout) -> tuple[list[RecordedCell], list[str]]:
    """The cells of a folder, each key once, and what is wrong with its plans and manifests."""
    cells: dict[str, RecordedCell] = {}
    problems: list[str] = []

    # Those of the runs, of the oldest spec first; a key that several have is that of the newest.
    try:
        for run in reversed(recorded_runs(layout).runs.values()):
            try:
                cells = {**{cell.key: cell for cell in run.cells}, **cells}
            except ArtifactError as error:
                problems.append(error.message)
    except StoreError as error:
        problems.append(error.message)

    # What else is in the store, by label.
    with suppress(StoreError):
        others = stored_keys(layout, KIND) - cells.keys()
        stored: list[RecordedCell] = []
        if others:
            stored = [cell for cell in stored_cells(layout) if cell.key in others]
        stored.sort(key=lambda cell: (cell.label, cell.key))
        cells |= {cell.key: cell for cell in stored}
        for key in sorted(others - cells.keys()):
            problems.append(f"the manifest of evaluate/{key} is damaged, or of another version")
    return list(cells.values()), problems
