"""What a plan wants to know of every artifact, kept in one file: reading 100,000 manifests takes half a minute.

The index is a cache. An entry counts as long as its manifest has the time and the size that it had when it was read; an index that is
removed, damaged or not writable costs time and nothing else. The sizes of the artifacts' files are looked up each time.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.store.artifact import is_file_name, listed_files, missing_file, read_manifest, replace_file, why_invalid
from wasp_cli.store.layout import MANIFEST, Layout, is_key
from wasp_cli.store.plain import read_plain

LEAST_GAIN = 50
"""Manifests that have to be read anew before the index is written again."""

Facts = Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""What to keep of a manifest, as JSON values. It may raise what a manifest of another form makes it raise."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One artifact."""

    stamp: tuple[int, int]
    """Time in nanoseconds and size of its manifest."""
    files: Mapping[str, int]
    """Size by relative name."""
    facts: Mapping[str, Any]
    """Empty where the manifest has another form."""


@dataclass(frozen=True)
class ArtifactIndex:
    """The artifacts of some kinds."""

    whole: Mapping[str, Mapping[str, Entry]] = field(default_factory=dict)
    """By kind and key."""
    damaged: Mapping[str, str] = field(default_factory=dict)
    """What is wrong with each other one, by key."""


def scan(layout: Layout, kinds: Iterable[str], facts: Facts, version: int) -> ArtifactIndex:
    """Look at every artifact of some kinds.

    Args:
        layout: the results folder; it need not be there.
        kinds: which kinds.
        facts: what to keep of a manifest.
        version: of `facts`; an index of another version is not used.

    Raises:
        StoreError: the folder cannot be read.
    """
    known = _read(layout, version)
    whole: dict[str, dict[str, Entry]] = {}
    damaged: dict[str, str] = {}
    fresh = 0
    for kind in dict.fromkeys(kinds):
        before, now = known.get(kind, {}), whole.setdefault(kind, {})
        folder = str(layout.kind(kind))
        for key in _keys(layout, kind):
            place = f"{folder}/{key}"  # a Path for each of 100,000 takes a second
            state = _state(f"{place}/{MANIFEST}")
            if state is None:
                damaged[key] = why_invalid(layout, kind, key) or f"'{place}/{MANIFEST}' is gone"
                continue
            entry = before.get(key)
            if entry is None or entry.stamp != (state.st_mtime_ns, state.st_size):
                fresh += 1
                try:
                    entry = _entry(layout.manifest(kind, key), read_manifest(layout, kind, key), (state.st_mtime_ns, state.st_size), facts)
                except ArtifactError as error:
                    damaged[key] = error.message
                    continue
            wrong = missing_file(layout, place, entry.files)
            if wrong is None:
                now[key] = entry
            else:
                damaged[key] = wrong
    if fresh >= LEAST_GAIN:
        _write(layout, {**known, **whole}, version)
    return ArtifactIndex(whole, damaged)


def _state(path: str) -> os.stat_result | None:
    try:
        return os.stat(path)
    except OSError:
        return None


def _keys(layout: Layout, kind: str) -> list[str]:
    folder = layout.kind(kind)
    try:
        with os.scandir(layout.within(folder)) as entries:
            return sorted(entry.name for entry in entries if is_key(entry.name) and entry.is_dir(follow_symlinks=False))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StoreError(f"cannot read '{folder}': {(error.strerror or str(error)).lower()}") from error


def _entry(path: Path, manifest: Mapping[str, Any], stamp: tuple[int, int], facts: Facts) -> Entry:
    files = listed_files(manifest, path)
    try:
        return Entry(stamp, files, facts(manifest))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return Entry(stamp, files, {})


def _read(layout: Layout, version: int) -> dict[str, dict[str, Entry]]:
    try:
        record = json.loads(read_plain(layout.index))
        if record["version"] != version:
            return {}
        return {kind: {key: _old(*values) for key, values in entries.items()} for kind, entries in record["kinds"].items()}
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError):
        return {}


def _old(time: int, size: int, files: dict[str, int], facts: dict[str, Any]) -> Entry:
    if not all(map(is_file_name, files)):
        raise ValueError("no files of an artifact")
    return Entry((time, size), files, facts)


def _write(layout: Layout, kinds: Mapping[str, Mapping[str, Entry]], version: int) -> None:
    lines = {kind: {key: [*entry.stamp, entry.files, entry.facts] for key, entry in entries.items()} for kind, entries in kinds.items()}
    text = json.dumps({"version": version, "kinds": lines}, separators=(",", ":"))
    with suppress(OSError):  # a store that is only read has no index of its own
        replace_file(layout.index, text)
