"""Which evaluated cell a person means: by key, by label, or by path.

    find_cell(Layout(Path("results")), "611a4993")                       the beginning of a key
    find_cell(Layout(Path("results")), "goal1 s0 wasp/no-case2 laggy=0.7")   a label, as `wasp run` and the report print it
    find_cell(Layout(Path("results")), "copied/cell.parquet")            a file, or the folder of an artifact

Keys and labels are compared with what is there; neither ever becomes a path.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wasp_cli.errors import ArtifactError, UnknownName, UsageError
from wasp_cli.store.artifact import published, read_manifest, read_record
from wasp_cli.store.layout import MANIFEST, Layout, is_key
from wasp_cli.store.tables import CELL_FILE

KIND = "evaluate"
"""The kind of node whose artifact is a cell."""

LEAST = 4
"""Characters of a key that name it, where they are unique."""

_PREFIX = re.compile(r"[0-9a-f]{1,64}")
_REPORTED = re.compile(r"(\S+) (.+) seed (\d+)")
SHOWN = 12
"""Candidates that an error lists at most."""


@dataclass(frozen=True)
class FoundCell:
    """A cell on disk, and what its manifest says of it."""

    path: Path
    """of the table"""
    key: str | None = None
    """None of a file outside of a store"""
    manifest: Mapping[str, Any] = field(default_factory=dict)
    """empty of a file outside of a store"""

    @property
    def label(self) -> str | None:
        """As the run printed it."""
        label = self.manifest.get("label")
        return None if label is None else str(label)

    @property
    def date(self) -> str:
        """When it was computed: day and minute, UTC; empty when unknown."""
        return self.started_at[:16].replace("T", " ")

    @property
    def started_at(self) -> str:
        """The same to the second, so that it sorts."""
        return str(self.setting("provenance", "started_at") or "")

    def setting(self, *names: str) -> Any:
        """A value of the manifest by the names on the way to it; None where it says nothing."""
        value: Any = self.manifest
        for name in names:
            value = value.get(name) if isinstance(value, Mapping) else None
        return value


def find_cell(layout: Layout, text: str) -> FoundCell:
    """The one cell that `text` names: the beginning of a key, a label, or a path.

    Raises:
        UsageError: it names several; the message lists them, newest first. Or it is a path without a cell.
        UnknownName: it names none.
        ArtifactError: the manifest of the cell is damaged.
    """
    wanted = " ".join(text.split())
    keys = sorted(filter(is_key, published(layout, KIND)))
    found = [_of_key(layout, key) for key in keys if _begins(key, wanted)]
    named: list[str] = []
    if not found:
        for cell in _readable(layout, keys):
            named.append(cell.label or "")
            if named[-1].casefold() == _as_run(wanted).casefold():
                found.append(cell)
    if len(found) > 1:
        raise UsageError(_several(wanted, found), "say the first characters of one of these keys")
    return found[0] if found else _by_path(layout, text, wanted, named)


def _begins(key: str, wanted: str) -> bool:
    return len(wanted) >= LEAST and key.startswith(wanted.lower())


def _as_run(label: str) -> str:
    """`goal1 wasp laggy=0.7 seed 0`, as reports name a cell, in the order of the run: `goal1 s0 wasp laggy=0.7`."""
    reported = _REPORTED.fullmatch(label)
    return f"{reported[1]} s{reported[3]} {reported[2]}" if reported else label


def _of_key(layout: Layout, key: str) -> FoundCell:
    return FoundCell(layout.artifact(KIND, key) / CELL_FILE, key, read_manifest(layout, KIND, key))


def _readable(layout: Layout, keys: Sequence[str]) -> Iterator[FoundCell]:
    """A cell whose manifest is damaged has lost its label; its key still finds it."""
    for key in keys:
        try:
            yield _of_key(layout, key)
        except ArtifactError:
            continue


def _by_path(layout: Layout, text: str, wanted: str, labels: Sequence[str]) -> FoundCell:
    """The cell of an existing file or folder."""
    path = Path(text)
    if os.path.isdir(text) and wanted:
        path = path / CELL_FILE
        if not os.path.isfile(path):
            raise UsageError(f"the folder '{text}' holds no {CELL_FILE}", f"say a key, a label, or a folder below {layout.kind(KIND)}")
    elif not os.path.isfile(text):
        raise _unknown(layout, wanted, labels)
    manifest = read_record(path.with_name(MANIFEST)) or {}
    key = manifest.get("key")
    return FoundCell(path, key if isinstance(key, str) and is_key(key) else None, manifest)


def _unknown(layout: Layout, wanted: str, labels: Sequence[str]) -> UsageError:
    if _PREFIX.fullmatch(wanted.lower()) and len(wanted) < LEAST:
        return UsageError(f"'{wanted}' is too short for a key", f"say at least {LEAST} characters of it, or a label")
    failed = _failure(layout, wanted)
    if failed is not None:
        return UsageError(f"'{wanted}' has no rows: it failed last with: {failed}", "run the spec again: what failed runs again")
    if not labels:
        hint = "wasp run SPEC --results DIR writes them; --results says where to look"
        return UsageError(f"no evaluation '{wanted}': '{layout.root}' holds none", hint)
    how = "say a key (a folder name in store/evaluate), a label such as " + f"'{labels[0]}', or the path of a {CELL_FILE}"
    return UnknownName("evaluation", wanted, set(labels), f"no evaluation '{wanted}' in '{layout.root}'", otherwise=how)


def _failure(layout: Layout, wanted: str) -> str | None:
    """Why the cell of a label, or of the beginning of a key, failed last; None where nothing of it did."""
    for path in sorted(layout.failures.glob("*.json")):
        try:
            record = read_record(path) or {}
        except ArtifactError:
            continue
        names = str(record.get("label")).casefold() == _as_run(wanted).casefold() or _begins(path.stem, wanted)
        if record.get("kind") == KIND and names:
            return str(record.get("message"))
    return None


def _several(wanted: str, found: Sequence[FoundCell]) -> str:
    newest = sorted(found, key=lambda cell: cell.started_at, reverse=True)
    lines = [f"  {cell.key}  {cell.label}  {cell.date}".rstrip() for cell in newest[:SHOWN]]
    more = [f"  and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return "\n".join([f"'{wanted}' names {len(found)} evaluations, newest first:", *lines, *more])
