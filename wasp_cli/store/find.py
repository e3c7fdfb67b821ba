"""Which node a person means: by key, by label, or, if it is an evaluated cell, by path.

    find_cell(Layout(Path("results")), "611a4993")                       the beginning of a key
    find_cell(Layout(Path("results")), "goal1 s0 wasp/no-case2 laggy=0.7")   a label, as `wasp run` and the report print it
    find_cell(Layout(Path("results")), "copied/episodes.parquet")        a file, or the folder of an artifact
    find_node(Layout(Path("results")), "goal1 s0 world_model")           a node of any kind, also one that failed

Keys and labels are compared with what is there; neither ever becomes a path.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from wasp_cli.errors import ArtifactError, UnknownName, UsageError
from wasp_cli.store.artifact import read_manifest, read_record, stored_keys, stored_kinds
from wasp_cli.store.layout import MANIFEST, Layout, is_key
from wasp_cli.store.plain import printable
from wasp_cli.store.tables import EPISODES_FILE, cell_file

KIND = "evaluate"  # the kind of node whose artifact is a cell

LEAST = 4  # characters of a key that name it, where they are unique

_PREFIX = re.compile(r"[0-9a-f]{1,64}")
_REPORTED = re.compile(r"(\S+) (.+) seed (\d+)")
SHOWN = 12  # candidates that an error lists at most
DIFFERENCES = 3  # settings by which it tells them apart
ONE_OF = "give the first characters of one of these keys, or the run with --run"


@dataclass(frozen=True)
class Found:
    """Something on disk, and what its manifest says of it."""

    path: Path
    key: str | None = None  # none of a file outside of a store
    manifest: Mapping[str, Any] = field(default_factory=dict)  # empty where there is none

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
        """Return a value of the manifest by the names on the way to it; None where it says nothing."""
        value: Any = self.manifest
        for name in names:
            value = value.get(name) if isinstance(value, Mapping) else None
        return value


@dataclass(frozen=True)
class FoundCell(Found):
    """A cell; `path` is that of its table."""


@dataclass(frozen=True)
class FoundNode(Found):
    """A node of any kind; `path` is the folder of its artifact, or the record of its failure where it has none."""

    kind: str = ""
    failure: Mapping[str, Any] = field(default_factory=dict)  # of its last failure; empty when it succeeded since

    @property
    def label(self) -> str | None:
        """As the run printed it."""
        label = self.manifest.get("label", self.failure.get("label"))
        return None if label is None else str(label)


Target = TypeVar("Target", FoundCell, FoundNode)


def find_cell(layout: Layout, text: str, within: Container[str] | None = None) -> FoundCell:
    """Return the one cell that `text` names: the beginning of a key, a label, or a path."""
    named, labels = _stored(layout, [KIND], text, within)
    cells = [FoundCell(layout.within(cell_file(node.path)), node.key, node.manifest) for node in named]
    return _only(cells, text, "evaluations") or _by_path(layout, text, labels)


def find_node(layout: Layout, text: str, within: Container[str] | None = None) -> FoundNode:
    """Return the one node that `text` names: the beginning of a key, or a label; of any kind, and also when it has only failed."""
    failures = {key: record for key, record in _failures(layout).items() if within is None or key in within}
    named, labels = _stored(layout, stored_kinds(layout), text, within)
    nodes = [replace(node, failure=failures.get(node.key or "", {})) for node in named]
    failed = [FoundNode(layout.failure(key), key, {}, str(record.get("kind", "")), record) for key, record in failures.items()]
    nodes += [node for node in matching(failed, text) if node.key not in {stored.key for stored in named}]
    labels += [node.label or "" for node in failed]
    if (node := _only(nodes, text, "nodes")) is not None:
        return node
    how = "give a key (a folder name in store/<kind>), or a label" + (f" such as '{labels[0]}'" if labels else "")
    raise UnknownName("node", text, set(labels), f"no node '{_one_line(text)}' in '{layout.root}'", otherwise=how)


def _stored(layout: Layout, kinds: Sequence[str], text: str, within: Container[str] | None) -> tuple[list[FoundNode], list[str]]:
    """The stored nodes that a text names; and, where it begins no key, the labels that there are."""
    places = [(kind, key) for kind in kinds for key in sorted(stored_keys(layout, kind)) if within is None or key in within]
    if by_key := [_node(layout, kind, key) for kind, key in places if _begins(key, _one_line(text))]:
        return by_key, []
    nodes: list[FoundNode] = []
    for kind, key in places:
        with suppress(ArtifactError):  # one that is damaged has lost its label; its key still finds it
            nodes.append(_node(layout, kind, key))
    return matching(nodes, text), [node.label or "" for node in nodes]


def _node(layout: Layout, kind: str, key: str) -> FoundNode:
    return FoundNode(layout.artifact(kind, key), key, read_manifest(layout, kind, key), kind)


class Named(Protocol):
    """What a key or a label names."""

    @property
    def key(self) -> str | None: ...

    @property
    def label(self) -> str | None: ...


Thing = TypeVar("Thing", bound=Named)


def matching(things: Iterable[Thing], text: str) -> list[Thing]:
    """Return the things whose key begins with what someone wrote; where there are none, those whose label it is."""
    things, text = list(things), _one_line(text)
    by_key = [thing for thing in things if _begins(thing.key or "", text)]
    return by_key or [thing for thing in things if same_label(thing.label or "", text)]


def _begins(key: str, text: str) -> bool:
    return len(text) >= LEAST and key.startswith(text.lower())


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _only(things: Sequence[Target], text: str, what: str) -> Target | None:
    if len(things) > 1:
        raise UsageError(_several(_one_line(text), what, things), ONE_OF)
    return things[0] if things else None


def _failures(layout: Layout) -> dict[str, dict[str, Any]]:
    """The records of last failures that read, by key."""
    found: dict[str, dict[str, Any]] = {}
    for path in sorted(layout.within(layout.failures).glob("*.json")):
        with suppress(ArtifactError):
            if is_key(path.stem):
                found[path.stem] = read_record(path) or {}
    return found


def same_label(label: str, wanted: str) -> bool:
    """Return whether what was written is a label, as a run or a report names it; capitals do not count."""
    return label.casefold() == _as_run(wanted).casefold()


def _as_run(label: str) -> str:
    """`goal1 wasp laggy=0.7 seed 0`, as reports name a cell, in the order of the run: `goal1 s0 wasp laggy=0.7`."""
    reported = _REPORTED.fullmatch(label)
    return f"{reported[1]} s{reported[3]} {reported[2]}" if reported else label


def _by_path(layout: Layout, text: str, labels: Sequence[str]) -> FoundCell:
    """The cell of an existing file or folder."""
    path = Path(text)
    if os.path.isdir(text) and text.strip():
        path = cell_file(path)
        if not os.path.isfile(path):
            hint = f"give a key, a label, or a folder below {layout.kind(KIND)}"
            raise UsageError(f"the folder '{text}' holds no {EPISODES_FILE}", hint)
    elif not os.path.isfile(text):
        raise _unknown(layout, _one_line(text), labels)
    manifest = read_record(path.with_name(MANIFEST)) or {}
    key = manifest.get("key")
    return FoundCell(path, key if isinstance(key, str) and is_key(key) else None, manifest)


def _unknown(layout: Layout, wanted: str, labels: Sequence[str]) -> UsageError:
    if _PREFIX.fullmatch(wanted.lower()) and len(wanted) < LEAST:
        return UsageError(f"'{wanted}' is too short for a key", f"give at least {LEAST} characters of it, or a label")
    failures = [
        FoundNode(layout.failure(key), key, {}, "", record) for key, record in _failures(layout).items() if record.get("kind") == KIND
    ]
    for node in matching(failures, wanted):
        message = f"'{wanted}' has no rows: it failed with: {node.failure.get('message')}"
        return UsageError(message, "run the spec again: what failed runs again")
    if not labels:
        hint = "wasp run SPEC --results DIR writes them; --results chooses where to look"
        return UsageError(f"no evaluation '{wanted}': '{layout.root}' holds none", hint)
    how = "give a key (a folder name in store/evaluate), a label such as " + f"'{labels[0]}', or the path of an {EPISODES_FILE}"
    return UnknownName("evaluation", wanted, set(labels), f"no evaluation '{wanted}' in '{layout.root}'", otherwise=how)


def _several(wanted: str, what: str, found: Sequence[Found]) -> str:
    newest = sorted(found, key=lambda each: each.started_at, reverse=True)
    lines = ["  " + "  ".join(filter(None, (each.key, each.label, each.date, told))) for each, told in _told_apart(newest[:SHOWN])]
    more = [f"  and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return "\n".join([f"'{wanted}' names {len(found)} {what}, newest first:", *lines, *more])


def _told_apart(found: Sequence[Found]) -> Iterator[tuple[Found, str]]:
    """Each with what it was computed with and the others were not, and with its run."""
    settings = [_flat({name: each.manifest.get(name) for name in ("axes", "config", "settings")}) for each in found]
    names = dict.fromkeys(name for of_one in settings for name in of_one)
    apart = [name for name in names if len({json.dumps(of_one.get(name), sort_keys=True) for of_one in settings}) > 1][:DIFFERENCES]
    for each, of_one in zip(found, settings, strict=True):
        said = [f"{name.partition('.')[2]}={printable(json.dumps(of_one.get(name)))}" for name in apart]
        run = each.setting("provenance", "run")
        yield each, ", ".join([*said, *([f"run {printable(str(run))}"] if run else [])])


def _flat(value: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """The values of nested settings by their dotted names."""
    found: dict[str, Any] = {}
    for name, part in value.items():
        found |= _flat(part, f"{before}{name}.") if isinstance(part, Mapping) else {f"{before}{name}": part}
    return found
