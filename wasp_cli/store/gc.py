"""What of a results folder can go, and its removal: artifacts that nobody needs, and what runs have left behind.

What is needed is said by the caller, as keys: the store knows of no runs and no specs.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from wasp_cli.errors import ArtifactError
from wasp_cli.store.artifact import artifact_keys, discard, left_behind, read_manifest, stored_kinds
from wasp_cli.store.layout import SESSION_FILE, Layout, is_key
from wasp_cli.store.lock import held_if_free, is_held, remove_lock
from wasp_cli.store.reached import reached

WORK, FAILURES, RUNS, TMP, LOCKS = "work of nodes", "records of failures", "runs", "left in tmp", "locks"
"""What can go besides artifacts, as people read it."""


@dataclass(frozen=True)
class Rubbish:
    """Something that can go."""

    what: str  # the kind of an artifact, or one of the above
    path: Path
    size: int  # bytes that its removal frees
    key: str | None = None  # of the node whose lock must be free; None where there is no such node


def stored(layout: Layout) -> dict[str, list[str]]:
    """Return the kinds under which a key has a folder in the store, damaged artifacts too."""
    found: dict[str, list[str]] = {}
    for kind in stored_kinds(layout):
        for key in artifact_keys(layout, kind):
            found.setdefault(key, []).append(kind)
    return found


def locked(layout: Layout) -> set[str]:
    """Return the keys of nodes that are being computed."""
    return {key for key in _keys(layout.locks) if is_held(layout.lock(key))}


def with_inputs(layout: Layout, keys: Iterable[str], there: Mapping[str, list[str]]) -> set[str]:
    """Return the keys and, as far as manifests say, everything that was read for them."""
    return reached(keys, lambda key: [needed for kind in there.get(key, ()) for needed in _upstream(layout, kind, key)])


def computed_from(layout: Layout, keys: Iterable[str], there: Mapping[str, list[str]]) -> set[str]:
    """Return the keys of everything that, as far as manifests say, was computed from something: step by step."""
    readers: dict[str, list[str]] = {}
    for key, kinds in there.items():
        for needed in (needed for kind in kinds for needed in _upstream(layout, kind, key)):
            readers.setdefault(needed, []).append(key)
    return reached((reader for key in keys for reader in readers.get(key, ())), lambda key: readers.get(key, ()))


def _upstream(layout: Layout, kind: str, key: str) -> list[str]:
    try:
        upstream = read_manifest(layout, kind, key).get("upstream")
    except ArtifactError:  # it is damaged, and will be computed again from what the plan says
        return []
    return [needed for needed in upstream.values() if isinstance(needed, str)] if isinstance(upstream, dict) else []


def unfinished_sessions(layout: Layout) -> set[str]:
    """Return the keys of the cells that a person has begun to drive."""
    return {key for key in _keys(layout.works) if os.path.lexists(layout.work(key) / SESSION_FILE)}


def rubbish(layout: Layout, needed: set[str], there: Mapping[str, list[str]], before: float | None = None) -> list[Rubbish]:
    """Return what can go, nothing of it written after `before`."""
    found = [_rubbish(kind, layout.artifact(kind, key), key) for key, kinds in there.items() if key not in needed for kind in kinds]
    sessions = unfinished_sessions(layout)
    works = [key for key in _keys(layout.works) if (key in there or key not in needed) and key not in sessions]
    found += [_rubbish(WORK, layout.work(key), key) for key in works]
    records = _keys(layout.failures, lambda entry: entry.is_file(follow_symlinks=False), ".json")
    found += [_rubbish(FAILURES, layout.failure(key), key) for key in records if key not in needed]
    found += [_rubbish(TMP, folder, folder.name.partition("-")[0]) for folder in left_behind(layout)]
    found += [_rubbish(LOCKS, layout.lock(key), key) for key in _keys(layout.locks)]
    free = [each for each in found if each.key is None or not is_held(layout.lock(each.key))]
    return [each for each in free if before is None or _written(each.path) < before]


def remove(layout: Layout, found: Iterable[Rubbish]) -> tuple[int, int]:
    """Remove what can go, each thing in one step, unless a process has taken its lock meanwhile; how many went, and their bytes."""
    count = freed = 0
    for each in sorted(found, key=lambda each: each.what == LOCKS):  # locks last: to take one makes its file
        if each.what == LOCKS:
            gone = remove_lock(each.path)
        elif each.key is None:
            gone = _remove(layout, each.path)
        else:
            with held_if_free(layout.lock(each.key)) as mine:
                gone = mine and _remove(layout, each.path)
            remove_lock(layout.lock(each.key))
        count, freed = count + gone, freed + each.size * gone
    return count, freed


def run_rubbish(layout: Layout, run_ids: Iterable[str], before: float | None = None) -> list[Rubbish]:
    """Return the folders of runs, as what can go; none of it written after `before`."""
    found = [_rubbish(RUNS, layout.run(run_id), None) for run_id in run_ids]
    return [each for each in found if before is None or _written(each.path) < before]


def size_of(path: Path) -> int:
    """Return the bytes of a file or of everything in a folder; links are not followed."""
    try:
        if path.is_symlink() or not path.is_dir():
            return path.lstat().st_size
        with os.scandir(path) as entries:
            return sum(size_of(Path(entry.path)) for entry in entries)
    except OSError:  # gone meanwhile, or not ours to read
        return 0


def _keys(folder: Path, fits: Callable[[os.DirEntry[str]], bool] = lambda entry: True, ending: str = "") -> Iterator[str]:
    """The names in a folder that are keys."""
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.name.endswith(ending) and is_key(entry.name.removesuffix(ending)) and fits(entry):
                    yield entry.name.removesuffix(ending)
    except FileNotFoundError:
        return


def _rubbish(what: str, path: Path, key: str | None) -> Rubbish:
    return Rubbish(what, path, size_of(path), key)


def _written(path: Path) -> float:
    try:
        return path.lstat().st_mtime
    except OSError:
        return 0.0


def _remove(layout: Layout, path: Path) -> bool:
    """Move something to `tmp/`, so that it is gone at once and as a whole, then delete it; a killed removal is swept by the next run."""
    aside = layout.tmp / f"{uuid.uuid4().hex}-removed"
    try:
        os.replace(path, aside)
    except FileNotFoundError:
        return False
    discard(aside)
    return True
