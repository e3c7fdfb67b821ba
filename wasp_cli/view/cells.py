"""The cells of a results folder for a table: names at once, from plans and manifests; their numbers as they are read, in the background."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wasp_cli.errors import ArtifactError, StoreError, UnknownName, WaspError
from wasp_cli.notebook.cells import ListedCell, planned_cells, recorded_plans, stored_cells
from wasp_cli.report.notes import FILE, invalid, notes_of, without_episodes
from wasp_cli.report.stats.frame import CellNumbers, Wanted, read_frame
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.report.tables.table import who_title
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.find import KIND, LEAST, FoundCell, find_cell, same_label
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.tables import cell_file

FRESH = 2.0
"""Seconds for which a listing counts as new: a live store grows."""
TOGETHER = 250
"""Cells whose numbers are read in one go, before the page is told of them."""
COLUMNS = PAPER_COLUMNS
"""What the table shows of a cell, as reports print it."""


@dataclass(frozen=True)
class Shown:
    """The numbers of a cell, or why there are none."""

    numbers: CellNumbers | None
    episodes: int = 0
    reason: str = ""
    damaged: bool = False

    @property
    def texts(self) -> list[str]:
        """Return the number of each of COLUMNS as a report prints it; nothing where there are no rows."""
        if self.numbers is None:
            return []
        return [column.number(self.numbers.pooled[column.key]) for column in COLUMNS]


class Cells:
    """What a folder has; safe to ask from several threads."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self._listed: list[ListedCell] = []
        self._labels: Counter[str] = Counter()
        self._problems: list[str] = []
        self._at = -FRESH
        self._numbers: dict[str, Shown] = {}
        self._noted = (0, 0)
        """Time and size of the file of notes when it was last read."""
        self._lock = threading.RLock()
        self._reader: threading.Thread | None = None

    def listed(self) -> list[ListedCell]:
        """Return every cell: those of the last run of each spec, then what else is in the store; each key once."""
        with self._lock:
            if time.monotonic() - self._at > FRESH:
                self._listed, self._problems = _listed(self.layout, {cell.key: cell for cell in self._listed})
                self._labels = Counter(cell.label for cell in self._listed)
                self._at = time.monotonic()
            return self._listed

    def ref(self, cell: ListedCell) -> str:
        """Return how a cell is named in addresses: by its label where that is its alone, else by its key."""
        self.listed()
        return cell.label if self._labels[cell.label] == 1 else cell.key

    @property
    def problems(self) -> list[str]:
        """What could not be listed, and why."""
        self.listed()
        return self._problems

    def numbers(self) -> tuple[Mapping[str, Shown], int]:
        """Return what is known by key, and how many cells are yet to be read; reading goes on in the background."""
        self._heed_notes()
        left = [cell for cell in self.listed() if cell.key not in self._numbers]
        with self._lock:
            if left and (self._reader is None or not self._reader.is_alive()):
                self._reader = threading.Thread(target=self._read, args=(left,), daemon=True, name="cells")
                self._reader.start()
        return self._numbers, len(left)

    def wait(self) -> Mapping[str, Shown]:
        """Return the numbers of all cells, read to the end."""
        while self.numbers()[1]:
            reader = self._reader
            if reader is not None:
                reader.join()
        return self._numbers

    def refresh(self) -> None:
        """Read the cells without rows again: what was absent may be there by now."""
        with self._lock:
            self._numbers = {key: shown for key, shown in self._numbers.items() if shown.numbers is not None}

    def _heed_notes(self) -> None:
        """Read the cells again of which somebody has noted something since, here or with the command."""
        try:
            state = os.stat(self.layout.root / FILE)
            stamp = (state.st_mtime_ns, state.st_size)
        except OSError:
            stamp = (0, 0)
        with self._lock:
            if stamp != self._noted:
                keys: set[str] = set()
                with suppress(StoreError):
                    keys = {note.key for note in notes_of(self.layout)}
                self._numbers = {key: shown for key, shown in self._numbers.items() if key not in keys}
                self._noted = stamp

    def one(self, cell: ListedCell) -> Shown:
        """Return the numbers of one cell, read now."""
        return self._shown([cell])[cell.key]

    def _read(self, cells: Sequence[ListedCell]) -> None:
        for first in range(0, len(cells), TOGETHER):
            part = cells[first : first + TOGETHER]
            try:
                found = self._shown(part)
            except Exception as error:  # whatever is wrong with one of them, the page must not wait for ever
                reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
                found = {cell.key: Shown(None, 0, reason, damaged=True) for cell in part}
            with self._lock:
                self._numbers = {**self._numbers, **found}

    def _shown(self, cells: Sequence[ListedCell]) -> dict[str, Shown]:
        """Read single cells; what is wrong with one is said of that one."""
        try:
            marked = invalid(notes_of(self.layout))
        except StoreError:
            marked = {}
        frame = read_frame([_wanted(self.layout, cell) for cell in cells])
        places = iter(frame.cells)
        gaps = {gap.label: gap for gap in frame.missing}
        found: dict[str, Shown] = {}
        for cell in cells:
            gap = gaps.get(cell.key)
            if gap is not None:
                found[cell.key] = Shown(None, 0, gap.reason, gap.damaged)
                continue
            numbers: CellNumbers | None = next(places)
            count = 0 if numbers is None else numbers.count
            out = {episode for (key, episode) in marked if key == cell.key and episode is not None}
            if (cell.key, None) in marked:
                found[cell.key] = Shown(None, count, "marked as invalid")
                continue
            if out and numbers is not None:
                numbers = without_episodes(numbers, out)
                count = 0 if numbers is None else numbers.count
            found[cell.key] = Shown(numbers, count, "" if numbers is not None else "all episodes are marked as invalid")
        return found

    def find(self, text: str) -> tuple[list[ListedCell], FoundCell | None]:
        """Return the listed cells that a label or the beginning of a key names, and the artifact where it is only one.

        Raises:
            WaspError: there is none, or its manifest is damaged.
        """
        wanted = " ".join(text.split())
        found = [cell for cell in self.listed() if len(wanted) >= LEAST and cell.key.startswith(wanted.lower())]
        found = found or [cell for cell in self.listed() if same_label(cell.label, wanted)]
        if len(found) > 1:
            # Of several versions of one cell the one of the newest run of its spec is meant; the page names the others.
            planned = [cell for cell in found if cell.spec is not None]
            if len({cell.key for cell in planned}) == 1:
                found = planned[:1]
        if len(found) > 1:
            return found, None
        if found:
            key = found[0].key
            return found, FoundCell(self.layout.within(cell_file(self.layout.artifact(KIND, key))), key, self._manifest(key))
        # What a person typed is compared with keys and labels, and never becomes a path: only what begins with a key may be a file.
        if wanted and not is_key(wanted):
            raise UnknownName("cell", wanted, [cell.label for cell in self.listed()])
        return [], find_cell(self.layout, wanted, self._keys())

    def _manifest(self, key: str) -> Mapping[str, Any]:
        """What is known of a cell; of one that is planned and not computed, nothing.

        Raises:
            ArtifactError: it is damaged.
        """
        return read_manifest(self.layout, KIND, key) if os.path.lexists(self.layout.artifact(KIND, key)) else {}

    def _keys(self) -> set[str]:
        return set(filter(is_key, stored_keys(self.layout, KIND)))


def _wanted(layout: Layout, cell: ListedCell) -> Wanted:
    """The key as its label: two cells of one identity have two keys."""
    folder, refused = layout.artifact(KIND, cell.key), None
    path: Path = cell_file(folder)
    try:
        layout.within(path)
    except StoreError as error:
        refused = error.message
    return Wanted(cell.identity, cell.key, path, cell.severity, None, None, refused)


def _listed(layout: Layout, known: Mapping[str, ListedCell]) -> tuple[list[ListedCell], list[str]]:
    found: dict[str, ListedCell] = {}
    problems: list[str] = []
    try:
        for name, plan in reversed(recorded_plans(layout).items()):
            try:
                found = {**{cell.key: cell for cell in planned_cells(name, plan)}, **found}
            except ArtifactError as error:
                problems.append(error.message)
    except StoreError as error:
        problems.append(error.message)
    with suppress(StoreError):
        others = {key for key in stored_keys(layout, KIND) if is_key(key)} - found.keys()
        if not others <= known.keys():
            known = {cell.key: cell for cell in stored_cells(layout)}
        there = [known[key] for key in others if key in known]
        found |= {cell.key: cell for cell in sorted(there, key=_order)}
        problems += [f"the manifest of evaluate/{key} is damaged, or of another version" for key in sorted(others - known.keys())]
    return list(found.values()), problems


def _order(cell: ListedCell) -> tuple[str, str, str, str, float, int, str]:
    return cell.task, cell.method, cell.variant, cell.operator, cell.value or 0.0, cell.seed, cell.key


def words(cell: ListedCell) -> Iterator[str]:
    """Yield what the table says of a cell beside its numbers: task, method, operator, severity, seed."""
    yield cell.task
    yield who_title(cell.method, cell.variant)
    yield cell.operator
    yield "" if cell.value is None else f"{cell.value:g}" + (f" ({cell.severity})" if cell.severity else "")
    yield str(cell.seed)


def problem_of(error: WaspError) -> str:
    """Return an error and what to do about it in one text."""
    return error.message + (f" ({error.hint})" if error.hint else "")
