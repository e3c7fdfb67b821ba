"""Which node a person means: by key, by label, or, if it is an evaluated cell, by path.

    find_cell(Layout(Path("results")), "611a4993")                       the beginning of a key
    find_cell(Layout(Path("results")), "goal1 s0 wasp/no-case2 laggy=0.7")   a label, as `wasp run`
    and the report print it find_cell(Layout(Path("results")), "copied/episodes.parquet")        a
    file, or the folder of an artifact find_node(Layout(Path("results")), "goal1 s0 world_model")
    a node of any kind, also one that failed

Keys and labels are compared with what is there; neither ever becomes a path.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from wasp_cli.errors import ArtifactError, UnknownName, UsageError, first
from wasp_cli.store.artifact import read_manifest, read_record, stored_keys, stored_kinds
from wasp_cli.store.layout import MANIFEST, Layout, is_key
from wasp_cli.store.plain import printable
from wasp_cli.store.severities import as_driven
from wasp_cli.store.tables import EPISODES_FILE, cell_file

KIND = "evaluate"  # the kind of node whose artifact is a cell
LEAST = 4  # characters of a key that name it, where they are unique
SHOWN = 12  # candidates that an error lists at most
_PREFIX = re.compile(r"[0-9a-f]{1,64}")
_REPORTED = re.compile(r"(\S+) (.+) seed (\d+)")


class Named(Protocol):
    @property
    def key(self) -> str | None: ...

    @property
    def label(self) -> str | None: ...


Thing = TypeVar("Thing", bound=Named)


@dataclass(frozen=True)
class FoundNode:
    """A node on disk, and what is known of it."""

    path: Path  # the folder of its artifact; of one that has only failed, the record of its failure
    key: str | None = None  # None of a file outside of a store
    manifest: Mapping[str, Any] = field(default_factory=dict)  # empty where there is none
    kind: str = ""
    # of its last failure; empty when it succeeded since
    failure: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str | None:
        """As the run printed it."""
        label = self.manifest.get("label", self.failure.get("label"))
        return None if label is None else str(label)

    @property
    def date(self) -> str:
        return self.started_at[:16].replace("T", " ")

    @property
    def started_at(self) -> str:
        """The same to the second, so that it sorts."""
        return str(self.setting("provenance", "started_at") or "")

    def setting(self, *names: str) -> Any:
        """Return a value of the manifest by the names on the way to it; None where it says
        nothing.
        """
        value: Any = self.manifest
        for name in names:
            value = value.get(name) if isinstance(value, Mapping) else None
        return value


@dataclass(frozen=True)
class FoundCell(FoundNode):
    """An evaluated cell; `path` is that of its table."""


def find_cell(layout: Layout, text: str, within: Container[str] | None = None) -> FoundCell:
    """Return the one cell that `text` names: the beginning of a key, a label, or a path.

    `within` are the keys that may be meant, of a run for example. Where it names several, a
    UsageError lists them, newest first.
    """
    nodes, labels = _stored(layout, [KIND], text, within)
    if (node := _newest(nodes, text, "evaluations")) is None:
        return _by_path(layout, text, labels)
    return FoundCell(layout.within(cell_file(node.path)), node.key, node.manifest, KIND)


def find_node(layout: Layout, text: str, within: Container[str] | None = None) -> FoundNode:
    """Return the one node that `text` names: the beginning of a key, or a label; of any kind,
    and also when it has only failed.
    """
    failures = {
        node.key: node for node in _failures(layout) if within is None or node.key in within
    }
    stored, labels = _stored(layout, stored_kinds(layout), text, within)
    nodes = [
        replace(node, failure=failures[node.key].failure) if node.key in failures else node
        for node in stored
    ]
    nodes += [
        node
        for node in matching(failures.values(), text)
        if node.key not in {other.key for other in stored}
    ]
    if (node := _newest(nodes, text, "nodes")) is not None:
        return node
    labels += [node.label or "" for node in failures.values()]
    how = "give a key (a folder name in store/<kind>), or a label" + (
        f" such as '{labels[0]}'" if labels else ""
    )
    raise UnknownName(
        "node", text, set(labels), f"no node '{_one_line(text)}' in '{layout.root}'", otherwise=how
    )


def _stored(
    layout: Layout, kinds: Sequence[str], text: str, within: Container[str] | None
) -> tuple[list[FoundNode], list[str]]:
    """The stored nodes that a text names; and, where it begins no key, the labels that there
    are.
    """
    places = [
        (kind, key)
        for kind in kinds
        for key in sorted(stored_keys(layout, kind))
        if within is None or key in within
    ]
    if by_key := [
        _node(layout, kind, key) for kind, key in places if _begins(key, _one_line(text))
    ]:
        return by_key, []
    nodes: list[FoundNode] = []
    for kind, key in places:
        # one that is damaged has lost its label; its key still finds it
        with suppress(ArtifactError):
            nodes.append(_node(layout, kind, key))
    name = _one_line(text)
    as_reported = [
        node for node in nodes if same_label(as_driven(node.label or "", node.manifest), name)
    ]
    return matching(nodes, text) or as_reported, [node.label or "" for node in nodes]


def _node(layout: Layout, kind: str, key: str) -> FoundNode:
    return FoundNode(layout.artifact(kind, key), key, read_manifest(layout, kind, key), kind)


def _newest(nodes: Iterable[FoundNode], text: str, what: str) -> FoundNode | None:
    """The node that is meant; of several, the error lists the newest first, each with its date
    and its run.
    """
    ordered = sorted(nodes, key=lambda node: node.started_at, reverse=True)
    about = {
        node.key: f"{node.date}  "
        f"{f'run {run}' if (run := node.setting('provenance', 'run')) else ''}".rstrip()
        for node in ordered
    }
    return only(ordered, text, f"{what}, newest first", lambda node: printable(about[node.key]))


def matching(things: Iterable[Thing], text: str) -> list[Thing]:
    """Return the things whose key begins with what someone wrote; where there are none, those
    whose label it is.
    """
    things, text = list(things), _one_line(text)
    by_key = [thing for thing in things if _begins(thing.key or "", text)]
    return by_key or [thing for thing in things if same_label(thing.label or "", text)]


def only(
    things: Sequence[Thing], text: str, what: str, about: Callable[[Thing], str] = lambda thing: ""
) -> Thing | None:
    """Return the thing that a text names, or None; a UsageError lists several, with what there
    is to say `about` each.
    """
    if len(things) > 1:
        lines = [
            "  ".join(filter(None, (thing.key, thing.label, about(thing)))) for thing in things
        ]
        lines = [
            f"'{_one_line(text)}' names {len(things)} {what}:",
            *first([f"  {line}" for line in lines], SHOWN),
        ]
        raise UsageError(
            "\n".join(lines),
            "give the first characters of one of these keys, or the run with --run",
        )
    return things[0] if things else None


def same_label(label: str, text: str) -> bool:
    """Return whether what was written is a label, as a run or a report names it; capitals do
    not count.
    """
    # As reports name a cell, `goal1 wasp laggy=0.7 seed 0`, in the order of the run: `goal1 s0 wasp
    # laggy=0.7`.
    reported = _REPORTED.fullmatch(text)
    return (
        label.casefold()
        == (f"{reported[1]} s{reported[3]} {reported[2]}" if reported else text).casefold()
    )


def _begins(key: str, text: str) -> bool:
    return len(text) >= LEAST and key.startswith(text.lower())


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _failures(layout: Layout) -> list[FoundNode]:
    """The nodes with a record of a failure that reads."""
    nodes: list[FoundNode] = []
    for path in sorted(layout.within(layout.failures).glob("*.json")):
        with suppress(ArtifactError):
            if is_key(path.stem):
                record = read_record(path) or {}
                nodes.append(FoundNode(path, path.stem, {}, str(record.get("kind", "")), record))
    return nodes


def _by_path(layout: Layout, text: str, labels: Sequence[str]) -> FoundCell:
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
    return FoundCell(path, key if isinstance(key, str) and is_key(key) else None, manifest, KIND)


def _unknown(layout: Layout, name: str, labels: Sequence[str]) -> UsageError:
    if _PREFIX.fullmatch(name.lower()) and len(name) < LEAST:
        return UsageError(
            f"'{name}' is too short for a key",
            f"give at least {LEAST} characters of it, or a label",
        )
    for node in matching((node for node in _failures(layout) if node.kind == KIND), name):
        message = f"'{name}' has no rows: it failed with: {node.failure.get('message')}"
        return UsageError(message, "run the spec again: what failed runs again")
    if not labels:
        hint = "wasp run SPEC --results DIR writes them; --results chooses where to look"
        return UsageError(f"no evaluation '{name}': '{layout.root}' holds none", hint)
    how = (
        f"give a key (a folder name in store/evaluate), a label such as '{labels[0]}', or the "
        f"path of an {EPISODES_FILE}"
    )
    return UnknownName(
        "evaluation", name, set(labels), f"no evaluation '{name}' in '{layout.root}'", otherwise=how
    )
