"""`wasp gc`: finds what is still needed in a results folder, and removes the rest.

Needed are the results of the newest run of each spec (see `reach_of_runs`), those of runs that go
on, and what a person did, which cannot be computed again.
"""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Callable, Container, Iterable, Iterator, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.text import Text

from wasp_cli.cells.runs import RunRecord, planned_run, run_ids
from wasp_cli.console import count_table, size, waiting_aloud
from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.reuse import NONE, lay_out_over
from wasp_cli.run.process import is_gone
from wasp_cli.run.watch import state_of
from wasp_cli.spec.load import load
from wasp_cli.store.artifact import artifact_keys, discard, left_behind, read_manifest, stored_kinds
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import SESSION_FILE, Layout, is_key
from wasp_cli.store.lock import held, held_if_free, is_held, remove_lock
from wasp_cli.store.reached import reached
from wasp_cli.store.records import read_record

# how long a run may take from making its folder to the first line of its journal
BEGINS_SECONDS = 3600.0
WORK = "work of nodes"
FAILURES = "records of failures"
RUNS = "runs"
TMP = "left in tmp"
LOCKS = "locks"
LAST = (WORK, FAILURES, RUNS, TMP, LOCKS)
"""What can be removed besides artifacts, in words."""


@dataclass(frozen=True)
class Rubbish:
    """Something in a results folder that can be removed."""

    what: str  # the kind of an artifact, or one of the above
    path: Path
    size: int  # bytes that its removal frees
    key: str | None  # of the node whose lock must be free; None where there is no such node


def kept_keys(layout: Layout, specs: Iterable[Path]) -> set[str]:
    """Return the keys of everything that specs ask for now, both with published results and
    without.
    """
    loaded = [load(path, ()).spec for path in specs]
    return {
        node.key
        for spec in loaded
        for reuse in {NONE, spec.reuse}
        for node in lay_out_over(spec, layout, reuse).nodes
    }


def unreached(layout: Layout, keep: set[str], *, runs: bool, before: float | None) -> list[Rubbish]:
    """Return what can be removed from a results folder.

    Args:
        keep: further keys to keep, with all that they were computed from.
        runs: whether the folders of runs are included.
        before: only what was written before this time, in seconds since the epoch; None:
            everything.

    Raises:
        StoreError: the plan of a run cannot be read, so what it needs is unknown, or a run is just
            being planned.
    """
    # All artifacts: by key the kinds under which it has a folder, and the keys of its inputs.
    kinds: dict[str, list[str]] = {}
    for kind in stored_kinds(layout):
        for key in artifact_keys(layout, kind):
            kinds.setdefault(key, []).append(kind)
    upstream = {
        key: [needed for kind in kinds[key] for needed in _upstream(layout, kind, key)]
        for key in kinds
    }

    # What is needed: by runs, by people and everything computed from that, and by processes now;
    # each with all that it was computed from.
    driven = {key for key in kinds if _is_of_people(layout, key, kinds[key])}
    sessions = {
        key for key in _keys(layout.works) if os.path.lexists(layout.work(key) / SESSION_FILE)
    }
    computing = {key for key in _keys(layout.locks) if is_held(layout.lock(key))}
    keys, other_runs = reach_of_runs(layout, driven | sessions)
    readers: dict[str, list[str]] = {}
    for reader, read in upstream.items():
        for key in read:
            readers.setdefault(key, []).append(reader)
    wanted = {*keys, *keep, *computing, *reached(driven, lambda key: readers.get(key, ()))}
    needed = reached(wanted, lambda key: upstream.get(key, ()))

    # The rest, as far as nobody holds its lock and it is old enough.
    items = [
        _rubbish(kind, layout.artifact(kind, key), key)
        for key in kinds
        if key not in needed
        for kind in kinds[key]
    ]
    items += _leavings(layout, kinds, needed, sessions)
    items = [item for item in items if item.key is None or not is_held(layout.lock(item.key))]
    items += [_rubbish(RUNS, layout.run(run_id), None) for run_id in other_runs if runs]
    return [item for item in items if before is None or _written(item.path) < before]


def reach_of_runs(layout: Layout, by_people: Set[str]) -> tuple[set[str], list[str]]:
    """Return the keys that runs need, and the runs that do not count.

    The runs that count are the newest whole run of each spec name, restricted runs after it, runs
    that go on, and runs with what people did.
    """
    counting: dict[str, RunRecord] = {}
    of_people: set[str] = set()
    keys: set[str] = set()
    newest: set[str] = set()
    ids = run_ids(layout)
    for run_id in ids:
        run = planned_run(layout, run_id)
        if run is None:
            folder = layout.run(run_id)
            if os.path.lexists(folder / "plan.json") or os.path.lexists(folder / "sweep.json"):
                why = f"the plan of '{folder}' cannot be read, so what it needs is unknown"
                raise StoreError(why, "remove that folder if nobody needs the run")
            if _age(layout, run_id) < BEGINS_SECONDS:  # an older one was killed while it began
                raise StoreError(f"run '{run_id}' is being planned", "try again once it runs")
            continue
        if run.spec not in newest or _goes_on(layout, run):
            counting[run_id] = run
        if not run.restricted:
            newest.add(run.spec)
        # A report finds a session by the run that asked for it.
        sessions = by_people & run.nodes.keys()
        if sessions:
            of_people.add(run_id)
            keys |= reached(sessions, partial(_needs, run))
    # A sweep that counts keeps the runs of its values: its reports are made from them.
    kept = {*counting, *of_people, *(part for run in counting.values() for part in run.values)}
    keys |= {key for run in counting.values() for key in run.nodes}
    return keys, [run_id for run_id in ids if run_id not in kept]


def _needs(run: RunRecord, key: str) -> Iterable[str]:
    """Return the keys that a planned node reads; none for a node of another run."""
    return run.nodes[key].needs if key in run.nodes else ()


def _goes_on(layout: Layout, run: RunRecord) -> bool:
    """Whether a run computes, is about to, or still has to write its report."""
    state = state_of(layout, run).state
    if state == "running":
        return True
    if state == "not started" and _age(layout, run.run_id) < BEGINS_SECONDS:
        return True
    if state in ("died", "interrupted"):
        return False
    with suppress(ArtifactError):  # a full disk has cut it off
        record = read_record(layout.reporting(run.run_id))
        return record is not None and not is_gone(record)
    return False


def _age(layout: Layout, run_id: str) -> float:
    return abs(time.time() - _written(layout.run(run_id), time.time()))


def _upstream(layout: Layout, kind: str, key: str) -> list[str]:
    try:
        upstream = read_manifest(layout, kind, key).get("upstream")
    except ArtifactError:  # it is damaged, and its inputs are those that plans name
        return []
    if not isinstance(upstream, dict):
        return []
    return [needed for needed in upstream.values() if isinstance(needed, str)]


def _is_of_people(layout: Layout, key: str, kinds: Sequence[str]) -> bool:
    """Whether an artifact is the clone of a person, or a cell that a person drove, even if it is
    damaged.
    """
    if KIND not in kinds:
        return "clone" in kinds
    if os.path.lexists(layout.artifact(KIND, key) / SESSION_FILE):
        return True
    try:
        axes = read_manifest(layout, KIND, key).get("axes")
    except ArtifactError:
        return False
    return isinstance(axes, dict) and axes.get("operator") == PERSON


def _leavings(
    layout: Layout, stored: Container[str], needed: set[str], sessions: set[str]
) -> Iterator[Rubbish]:
    """What nodes have left beside artifacts. The work of a finished node can be removed, unless it
    is that of a person.
    """
    for key in _keys(layout.works):
        if (key in stored or key not in needed) and key not in sessions:
            yield _rubbish(WORK, layout.work(key), key)
    for key in _keys(layout.failures, lambda entry: entry.is_file(follow_symlinks=False), ".json"):
        if key not in needed:
            yield _rubbish(FAILURES, layout.failure(key), key)
    for folder in left_behind(layout):
        yield _rubbish(TMP, folder, folder.name.partition("-")[0])
    for key in _keys(layout.locks):
        yield _rubbish(LOCKS, layout.lock(key), key)


def _keys(
    folder: Path, fits: Callable[[os.DirEntry[str]], bool] = lambda entry: True, ending: str = ""
) -> Iterator[str]:
    with suppress(FileNotFoundError), os.scandir(folder) as entries:
        for entry in entries:
            if (
                entry.name.endswith(ending)
                and is_key(entry.name.removesuffix(ending))
                and fits(entry)
            ):
                yield entry.name.removesuffix(ending)


def _rubbish(what: str, path: Path, key: str | None) -> Rubbish:
    return Rubbish(what, path, size_of(path), key)


def size_of(path: Path) -> int:
    """Return the bytes of a file or of everything in a folder; links are not followed."""
    with suppress(OSError):  # gone meanwhile, or not ours to read
        if path.is_symlink() or not path.is_dir():
            return path.lstat().st_size
        with os.scandir(path) as entries:
            return sum(size_of(Path(entry.path)) for entry in entries)
    return 0


def _written(path: Path, otherwise: float = 0.0) -> float:
    with suppress(OSError):
        return path.lstat().st_mtime
    return otherwise


def remove_unreached(
    layout: Layout, keep: set[str], shown: Iterable[Rubbish], *, runs: bool, before: float | None
) -> tuple[int, int]:
    """Remove what the user has agreed to, unless it is needed again: a run may have begun since.

    Args:
        shown: what the user has agreed to; the other arguments are those of `unreached`.

    Returns:
        How many things were removed, and their bytes.
    """
    agreed = {item.path for item in shown}
    # While this lock is held, no run is planned; runs that were planned before have their plans in
    # their folders.
    with held(layout.planning, waiting_aloud("waiting for a run that is being planned")):
        still_unreached = unreached(layout, keep, runs=runs, before=before)
        return remove(layout, [item for item in still_unreached if item.path in agreed])


def remove(layout: Layout, items: Iterable[Rubbish]) -> tuple[int, int]:
    """Remove things, each in one step, unless a process holds the lock of its node. Returns how
    many were removed, and their bytes.
    """
    count = 0
    freed = 0
    # Locks come last: taking a lock creates its file.
    for item in sorted(items, key=lambda item: item.what == LOCKS):
        if item.what == LOCKS:
            is_removed = remove_lock(item.path)
        elif item.key is None:
            is_removed = _remove(layout, item.path)
        else:
            with held_if_free(layout.lock(item.key)) as mine:
                is_removed = mine and _remove(layout, item.path)
            remove_lock(layout.lock(item.key))
        if is_removed:
            count += 1
            freed += item.size
    return count, freed


def _remove(layout: Layout, path: Path) -> bool:
    """Move something to `tmp/`, so that all of it is gone at once, then delete it. If the process
    is killed meanwhile, the next run deletes the rest. Returns whether it was there.
    """
    layout.tmp.mkdir(exist_ok=True)  # it may have been removed
    aside = layout.tmp / f"{uuid.uuid4().hex}-removed"
    try:
        os.replace(path, aside)
    except FileNotFoundError:
        return False
    discard(aside)
    return True


def show_rubbish(rubbish: Sequence[Rubbish], console: Console) -> None:
    """Print what would be removed, and why."""
    if not rubbish:
        console.print("there is nothing to remove")
        return
    table = count_table("what can go", "count", "size")
    kinds = sorted({item.what for item in rubbish} - set(LAST)) + [
        what for what in LAST if any(item.what == what for item in rubbish)
    ]
    for kind in kinds:
        sizes = [item.size for item in rubbish if item.what == kind]
        table.add_row(Text(kind), str(len(sizes)), size(sum(sizes)))
    table.add_section()
    table.add_row(
        "total", str(len(rubbish)), size(sum(item.size for item in rubbish)), style="bold"
    )
    console.print(table)
