"""The cells of a results folder for a table: names at once, from plans and manifests; their numbers as they are read, in the background."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from wasp_cli.errors import ArtifactError, StoreError, UnknownName
from wasp_cli.notebook.cells import ListedCell, planned_cells, recorded_plans, stored_cells
from wasp_cli.report.notes import invalid, notes_of, without_episodes
from wasp_cli.report.stats.frame import CellNumbers, Wanted, read_frame
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.report.tables.table import who_title
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.find import KIND, FoundCell, find_cell, matching
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.tables import cell_file

FRESH = 2.0  # seconds for which a listing counts as new: a live store grows
TOGETHER = 250  # cells whose numbers are read in one go, before the page is told of them
COLUMNS = PAPER_COLUMNS  # what the table shows of a cell, as reports print it


@dataclass(frozen=True)
class Shown:
    """The numbers of a cell, or why there are none."""

    numbers: CellNumbers | None
    episodes: int = 0
    reason: str = ""  # why there are none, or what is odd about them
    damaged: bool = False

    @property
    def texts(self) -> list[str]:
        if self.numbers is None:
            return []
        return [column.number(self.numbers.pooled[column.key]) for column in COLUMNS]

    @property
    def row(self) -> list[str]:
        """Return what the table of cells says: the number of episodes, one text for each of COLUMNS, what is odd."""
        return [str(self.episodes or ""), *(self.texts or [""] * len(COLUMNS)), "damaged" if self.damaged else self.reason]

    def without(self, invalid: Collection[int | None]) -> Shown:
        """Return the cell without the episodes that are marked as invalid; None stands for the whole cell."""
        if self.numbers is None:
            return self
        if None in invalid:
            return replace(self, numbers=None, reason="marked as invalid")
        numbers = without_episodes(self.numbers, {episode for episode in invalid if episode is not None})
        if numbers is None:
            return Shown(None, 0, "all episodes are marked as invalid")
        return Shown(numbers, numbers.count, "has invalid episodes")


class Cells:
    """What a folder has; safe to ask from several threads."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self._listed: list[ListedCell] = []
        self._labels: Counter[str] = Counter()
        self._problems: list[str] = []
        self._at = -FRESH
        self._read: dict[str, Shown] = {}
        """As they are stored: what is marked as invalid is in them."""
        self._lock = threading.RLock()
        self._reader: threading.Thread | None = None

    def listed(self) -> list[ListedCell]:
        """Return every cell: those of the last run of each spec, then what else is in the store; each key once."""
        with self._lock:
            if time.monotonic() - self._at > FRESH:
                self._listed, self._problems = _listed(self.layout)
                self._labels = Counter(cell.label for cell in self._listed)
                self._at = time.monotonic()
            return self._listed

    def ref(self, cell: ListedCell) -> str:
        """Return how a cell is named in addresses: by its label where that is its alone, else by its key."""
        self.listed()
        return cell.label if self._labels[cell.label] == 1 else cell.key

    @property
    def problems(self) -> list[str]:
        self.listed()
        return self._problems

    def numbers(self) -> tuple[Mapping[str, Shown], int]:
        """Return what is known by key, and how many cells are yet to be read; reading goes on in the background."""
        left = [cell for cell in self.listed() if cell.key not in self._read]
        with self._lock:
            if left and (self._reader is None or not self._reader.is_alive()):
                self._reader = threading.Thread(target=self._read_all, args=(left,), daemon=True, name="cells")
                self._reader.start()
        return self._without_invalid(self._read), len(left)

    def wait(self) -> Mapping[str, Shown]:
        """Return the numbers of all cells, read to the end."""
        while self.numbers()[1]:
            reader = self._reader
            if reader is not None:
                reader.join()
        return self.numbers()[0]

    def refresh(self) -> None:
        """Read the cells without rows again: what was absent may be there by now."""
        with self._lock:
            self._read = {key: shown for key, shown in self._read.items() if shown.numbers is not None}

    def one(self, cell: ListedCell) -> Shown:
        """Return the numbers of one cell, read now."""
        return self._without_invalid(self._shown([cell]))[cell.key]

    def _read_all(self, cells: Sequence[ListedCell]) -> None:
        for first in range(0, len(cells), TOGETHER):
            part = cells[first : first + TOGETHER]
            try:
                shown = self._shown(part)
            except Exception as error:  # whatever is wrong with one of them, the page must not wait for ever
                reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
                shown = {cell.key: Shown(None, 0, reason, damaged=True) for cell in part}
            with self._lock:
                self._read = {**self._read, **shown}

    def _shown(self, cells: Sequence[ListedCell]) -> dict[str, Shown]:
        """Read single cells; what is wrong with one is said of that one."""
        frame = read_frame([_wanted(self.layout, cell) for cell in cells])
        shown = {gap.label: Shown(None, 0, gap.reason, gap.damaged) for gap in frame.missing}
        there = [cell.key for cell in cells if cell.key not in shown]
        return shown | {key: Shown(numbers, numbers.count) for key, numbers in zip(there, frame.cells, strict=True)}

    def _without_invalid(self, shown: Mapping[str, Shown]) -> Mapping[str, Shown]:
        marked: dict[str, set[int | None]] = {}
        with suppress(StoreError):  # the first page says that notes do not read
            for key, episode in invalid(notes_of(self.layout)):
                if key in shown:
                    marked.setdefault(key, set()).add(episode)
        return {**shown, **{key: shown[key].without(episodes) for key, episodes in marked.items()}}

    def find(self, text: str) -> tuple[list[ListedCell], FoundCell | None]:
        """Return the listed cells that a label or the beginning of a key names, and the artifact where it is only one."""
        cells = matching(self.listed(), text)
        if len(cells) > 1:
            # Of several versions of one cell the one of the newest run of its spec is meant; the page names the others.
            planned = [cell for cell in cells if cell.spec is not None]
            if len({cell.key for cell in planned}) != 1:
                return cells, None
            cells = planned[:1]
        if cells:
            key = cells[0].key
            # Of a cell that is planned and not computed nothing is known.
            manifest = read_manifest(self.layout, KIND, key) if os.path.lexists(self.layout.artifact(KIND, key)) else {}
            return cells, FoundCell(self.layout.within(cell_file(self.layout.artifact(KIND, key))), key, manifest)
        # What a person typed is compared with keys and labels, and never becomes a path: only what begins with a key may be a file.
        typed = " ".join(text.split())
        if typed and not is_key(typed):
            raise UnknownName("cell", typed, [cell.label for cell in self.listed()])
        return [], find_cell(self.layout, typed, set(filter(is_key, stored_keys(self.layout, KIND))))


def _wanted(layout: Layout, cell: ListedCell) -> Wanted:
    """The key as its label: two cells of one identity have two keys."""
    folder, refused = layout.artifact(KIND, cell.key), None
    path: Path = cell_file(folder)
    try:
        layout.within(path)
    except StoreError as error:
        refused = error.message
    return Wanted(cell.identity, cell.key, path, cell.severity, None, None, refused)


def _listed(layout: Layout) -> tuple[list[ListedCell], list[str]]:
    cells: dict[str, ListedCell] = {}
    problems: list[str] = []
    try:
        for name, plan in reversed(recorded_plans(layout).items()):
            try:
                cells = {**{cell.key: cell for cell in planned_cells(name, plan)}, **cells}
            except ArtifactError as error:
                problems.append(error.message)
    except StoreError as error:
        problems.append(error.message)
    with suppress(StoreError):
        others = {key for key in stored_keys(layout, KIND) if is_key(key)} - cells.keys()
        stored = {cell.key: cell for cell in stored_cells(layout)} if others else {}
        cells |= {cell.key: cell for cell in sorted((stored[key] for key in others & stored.keys()), key=_order)}
        problems += [f"the manifest of evaluate/{key} is damaged, or of another version" for key in sorted(others - stored.keys())]
    return list(cells.values()), problems


def _order(cell: ListedCell) -> tuple[str, str, str, str, float, int, str]:
    return cell.task, cell.method, cell.variant, cell.operator, cell.value or 0.0, cell.seed, cell.key


def words(cell: ListedCell) -> tuple[str, ...]:
    """Return what the table says of a cell beside its numbers: task, method, operator, severity, seed."""
    severity = "" if cell.value is None else f"{cell.value:g}" + (f" ({cell.severity})" if cell.severity else "")
    return cell.task, who_title(cell.method, cell.variant), cell.operator, severity, str(cell.seed)
