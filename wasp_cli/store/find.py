"""The nodes of a results folder that a text names: by key, by label, or, for an evaluated cell, by
path.

    layout = Layout(Path("results"))
    find_cell(layout, "611a4993")                          the beginning of a key
    find_cell(layout, "goal1 s0 wasp/no-case2 laggy=0.7")  a label, as runs and reports print it
    find_cell(layout, "copied/episodes.parquet")           a file, or the folder of an artifact
    find_node(layout, "goal1 s0 world_model")              a node of any kind, also one that failed

Keys and labels are compared with those that are there; no path is ever made of one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from wasp_cli.errors import ArtifactError, UnknownName, UsageError
from wasp_cli.store.artifact import read_manifest, stored_keys, stored_kinds
from wasp_cli.store.layout import MANIFEST, Layout, is_key
from wasp_cli.store.named import LEAST, begins, matching, one_line, only, same_label
from wasp_cli.store.plain import printable
from wasp_cli.store.records import read_record
from wasp_cli.store.severities import as_driven
from wasp_cli.store.tables import EPISODES_FILE, cell_file

KIND = "evaluate"  # the kind of node whose artifact is a cell
_PREFIX = re.compile(r"[0-9a-f]{1,64}")


@dataclass(frozen=True)
class FoundNode:
    """A node on disk, with its manifest and the record of its failure."""

    path: Path  # the folder of its artifact; of one that has only failed, the record of its failure
    key: str | None = None  # None of a file outside of a store
    manifest: Mapping[str, Any] = field(default_factory=dict)  # empty where there is none
    kind: str = ""
    # of its last failure; empty when it succeeded since
    failure: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str | None:
        """As the run printed it; None where nothing says it."""
        label = self.manifest.get("label", self.failure.get("label"))
        return None if label is None else str(label)

    @property
    def date(self) -> str:
        """When it was started, to the minute, for people; empty where that is unknown."""
        return self.started_at[:16].replace("T", " ")

    @property
    def started_at(self) -> str:
        """When it was started, as a text that sorts by time; empty where that is unknown."""
        return str(self.setting("provenance", "started_at") or "")

    def setting(self, *names: str) -> Any:
        """Return a value of the manifest by the names on the way to it; None where it is absent."""
        value: Any = self.manifest
        for name in names:
            value = value.get(name) if isinstance(value, Mapping) else None
        return value


@dataclass(frozen=True)
class FoundCell(FoundNode):
    """An evaluated cell; `path` is that of its table."""


def find_cell(layout: Layout, text: str, within: Container[str] | None = None) -> FoundCell:
    """Return the one cell that `text` names: the beginning of a key, a label, or a path.

    Args:
        layout: of the results folder.
        text: as it was written.
        within: the keys that may be meant, of a run for example; None: all.

    Raises:
        UsageError: it names several, which are listed, newest first; or none (UnknownName).
    """
    nodes, labels = _stored(layout, [KIND], text, within)
    node = _newest(nodes, text, "evaluations")
    if node is None:
        return _by_path(layout, text, labels)
    return FoundCell(layout.within(cell_file(node.path)), node.key, node.manifest, KIND)


def find_node(layout: Layout, text: str, within: Container[str] | None = None) -> FoundNode:
    """Return the one node that `text` names: the beginning of a key, or a label; of any kind,
    and also when it has only failed. Arguments and errors as of `find_cell`.
    """
    failures: dict[str | None, FoundNode] = {}
    for node in _failures(layout):
        if within is None or node.key in within:
            failures[node.key] = node
    # Stored nodes, each with its last failure, and nodes that have only failed.
    stored, labels = _stored(layout, stored_kinds(layout), text, within)
    nodes: list[FoundNode] = []
    for node in stored:
        failed = failures.get(node.key)
        nodes.append(node if failed is None else replace(node, failure=failed.failure))
    keys_in_store = {node.key for node in stored}
    for node in matching(failures.values(), text):
        if node.key not in keys_in_store:
            nodes.append(node)
    newest = _newest(nodes, text, "nodes")
    if newest is not None:
        return newest
    # None: say what there is.
    labels += [node.label or "" for node in failures.values()]
    how = "give a key (a folder name in store/<kind>), or a label"
    if labels:
        how += f" such as '{labels[0]}'"
    raise UnknownName(
        "node", text, set(labels), f"no node '{one_line(text)}' in '{layout.root}'", otherwise=how
    )


def _stored(
    layout: Layout, kinds: Sequence[str], text: str, within: Container[str] | None
) -> tuple[list[FoundNode], list[str]]:
    """The stored nodes that a text names; and all labels, unless it is the beginning of a key."""
    places: list[tuple[str, str]] = []
    for kind in kinds:
        for key in sorted(stored_keys(layout, kind)):
            if within is None or key in within:
                places.append((kind, key))
    line = one_line(text)
    by_key = [_node(layout, kind, key) for kind, key in places if begins(key, line)]
    if by_key:
        return by_key, []
    nodes: list[FoundNode] = []
    for kind, key in places:
        # A damaged one has lost its label; it is still found by its key.
        with suppress(ArtifactError):
            nodes.append(_node(layout, kind, key))
    name = one_line(text)
    as_reported = [
        node for node in nodes if same_label(as_driven(node.label or "", node.manifest), name)
    ]
    return matching(nodes, text) or as_reported, [node.label or "" for node in nodes]


def _node(layout: Layout, kind: str, key: str) -> FoundNode:
    return FoundNode(layout.artifact(kind, key), key, read_manifest(layout, kind, key), kind)


def _newest(nodes: Iterable[FoundNode], text: str, what: str) -> FoundNode | None:
    """The node that a text names; of several, the error lists the newest first."""
    ordered = sorted(nodes, key=_started_at, reverse=True)
    return only(ordered, text, f"{what}, newest first", _when_and_run)


def _started_at(node: FoundNode) -> str:
    return node.started_at


def _when_and_run(node: FoundNode) -> str:
    """The date of a node and its run, for the list of several."""
    run = node.setting("provenance", "run")
    if run:
        return printable(f"{node.date}  run {run}".rstrip())
    return printable(node.date.rstrip())


def _failures(layout: Layout) -> list[FoundNode]:
    """The nodes whose last failure has a record that can be read."""
    nodes: list[FoundNode] = []
    for path in sorted(layout.within(layout.failures).glob("*.json")):
        with suppress(ArtifactError):
            if is_key(path.stem):
                record = read_record(path) or {}
                nodes.append(FoundNode(path, path.stem, {}, str(record.get("kind", "")), record))
    return nodes


def _by_path(layout: Layout, text: str, labels: Sequence[str]) -> FoundCell:
    """The cell at a path: that of its table, or of the folder of its artifact."""
    path = Path(text)
    if os.path.isdir(text) and text.strip():
        path = cell_file(path)
        if not os.path.isfile(path):
            hint = f"give a key, a label, or a folder below {layout.kind(KIND)}"
            raise UsageError(f"the folder '{text}' holds no {EPISODES_FILE}", hint)
    elif not os.path.isfile(text):
        raise _unknown(layout, one_line(text), labels)
    manifest = read_record(path.with_name(MANIFEST)) or {}
    key = manifest.get("key")
    if not isinstance(key, str) or not is_key(key):
        key = None
    return FoundCell(path, key, manifest, KIND)


def _unknown(layout: Layout, name: str, labels: Sequence[str]) -> UsageError:
    """The error for a text that names no cell."""
    if _PREFIX.fullmatch(name.lower()) and len(name) < LEAST:
        return UsageError(
            f"'{name}' is too short for a key",
            f"give at least {LEAST} characters of it, or a label",
        )
    failed_cells = [node for node in _failures(layout) if node.kind == KIND]
    for node in matching(failed_cells, name):
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
