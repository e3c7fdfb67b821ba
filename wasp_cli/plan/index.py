"""What plans need from the manifests of a results folder, kept between plans (`spec.kept`): opening
and parsing thousands of JSON files takes longer than the rest of a plan.

The folders are listed again each time, and what was kept of a manifest counts only if its file is
still the same (`artifact.stamp_of`). So it does not matter who adds, changes or removes artifacts,
or when: other processes, `wasp gc`, or people by hand. The times of a file are compared with its
earlier times, not with a clock. Files that were written within the last RACY seconds are not kept:
a second write within one tick of the file system's clock would look the same.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any

from wasp_cli.spec import kept
from wasp_cli.store import artifact, layout, plain, published, records, slim
from wasp_cli.store.layout import MANIFEST, Layout

Row = list[Any]  # what is wanted of a manifest; it has to be the same when read from JSON

RACY = 2.0  # seconds; the coarsest clock of a file system that is in use ticks so often
LEAST = 100  # manifests; fewer are read as fast as the index of them
_READERS = (artifact, layout, plain, published, records, slim)


class Index:
    """Rows of the manifests of one results folder.

    Args:
        layout: of the results folder.
        name: of what is wanted of the manifests.
        code: the modules that make a row, beside those that read a manifest.
        read: makes the row of an artifact, from its kind and key; None where it is to be left out.
    """

    def __init__(
        self,
        layout: Layout,
        name: str,
        code: tuple[ModuleType, ...],
        read: Callable[[str, str], Row | None],
    ) -> None:
        self._layout = layout
        self._read = read
        self._name = name_of(name, layout)
        self._version = kept.code_version(*_READERS, *code)
        self._known = kept.read_kept(self._name, self._version)
        self._seen: dict[str, dict[str, list[Any]]] = {}
        self._read_again = 0
        self._begun = time.time_ns()

    def rows(self, kind: str) -> dict[str, Row]:
        """Return the row of every artifact of a kind, by key. Raises what `artifact_keys` and
        `read` do.
        """
        folder = str(self._layout.kind(kind))
        known = self._known.get(kind, {})
        seen = self._seen[kind] = {}
        rows: dict[str, Row] = {}
        for key in artifact.artifact_keys(self._layout, kind):
            stamp = artifact.stamp_of(f"{folder}/{key}/{MANIFEST}")
            entry = known.get(key)
            if entry is None or stamp is None or entry[0] != list(stamp):
                row = self._read(kind, key)
                if row is None:
                    continue
                entry = [stamp and list(stamp), row]
                self._read_again += stamp is not None
            rows[key] = entry[1]
            if stamp is not None and is_settled(stamp, self._begun):
                seen[key] = entry
        return rows

    def save(self) -> None:
        """Keep the rows of the kinds that were read, if any has changed. Rows of other kinds
        stay.
        """
        gone = any(
            not self._known.get(kind, {}).keys() <= seen.keys() for kind, seen in self._seen.items()
        )
        values = {**self._known, **self._seen}
        if (self._read_again or gone) and sum(map(len, values.values())) >= LEAST:
            kept.keep(self._name, self._version, values)


def name_of(what: str, layout: Layout) -> str:
    """Return the name under which something is kept of a results folder."""
    root = hashlib.sha256(os.fsencode(layout.root.absolute())).hexdigest()[:20]
    return f"{what}-{root}"


def is_settled(stamp: artifact.Stamp, now: int) -> bool:
    """Return whether a file was last written long enough before `now` (in ns) that another write
    would change its stamp.
    """
    return max(stamp[2:]) < now - int(RACY * 1e9)
