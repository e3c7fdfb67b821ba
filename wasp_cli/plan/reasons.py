"""What a plan reads in manifests (how long nodes took, earlier versions of them), and why a node is computed anew."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from statistics import median
from typing import Any

from pydantic import ValidationError

from wasp_cli.errors import ArtifactError
from wasp_cli.plan.closure import source_hashes
from wasp_cli.plan.grid import stage_class
from wasp_cli.plan.keys import canonical, libraries
from wasp_cli.plan.node import Node, sort_of
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.index import ArtifactIndex, Entry
from wasp_cli.store.layout import Layout
from wasp_cli.store.slim import precision_of

VERSION = 3
"""Raised when `facts_of` changes."""


def facts_of(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the index of a store keeps of a manifest.

    `who` is the same for all versions of one node; `sort` is `Node.sort`; `signature` is the same for versions which differ from a node in
    the same way; `seconds` is what it took, `at` when that was; `precision` is what of it is not in full precision.
    """
    provenance = manifest["provenance"]
    axes = manifest["axes"]
    differing = [manifest[name] for name in ("config", "settings", "sources", "upstream")]
    return {
        "who": who(str(manifest["kind"]), str(manifest["task"]), int(manifest["seed"]), axes),
        "sort": sort_of(manifest["kind"], manifest["task"], manifest["config"], axes),
        "signature": _digest([*differing, axes.get("method_config"), provenance.get("versions")]),
        # What took rows over says nothing of how long its like takes.
        **({} if "earlier" in provenance else {"seconds": float(provenance["seconds"])}),
        "at": str(provenance.get("started_at", "")),
        **({"precision": precision} if (precision := precision_of(manifest)) else {}),
        **({"episodes": int(manifest["config"]["episodes"])} if "episodes" in manifest["config"] else {}),
    }


def who(kind: str, task: str, seed: int, axes: Mapping[str, Any]) -> str:
    """Return the identity of a node without its configuration: who assists whom, where, with which seed."""
    method = axes.get("method_config")
    variant = method.get("variant") if isinstance(method, Mapping) else None
    # By hand: this is asked of every node of a grid.
    return f"{kind} {task} {seed} {axes.get('method')} {variant} {axes.get('operator')} {axes.get('value')!r}"


def who_is(node: Node) -> str:
    """Return `who` of a node."""
    return who(node.kind, node.task, node.seed, node.axes)


def measured(index: ArtifactIndex) -> dict[str, float]:
    """Return the median seconds by sort of node."""
    times: dict[str, list[float]] = {}
    for entries in index.whole.values():
        for entry in entries.values():
            if "seconds" in entry.facts:
                times.setdefault(str(entry.facts["sort"]), []).append(float(entry.facts["seconds"]))
    return {sort: median(values) for sort, values in times.items()}


def versions(index: ArtifactIndex, kinds: Iterable[str]) -> dict[str, list[tuple[str, Entry]]]:
    """Return, by `who`, the key and the entry of every version in the store, newest first."""
    found: dict[str, list[tuple[str, Entry]]] = {}
    for kind in kinds:
        for key, entry in index.whole.get(kind, {}).items():
            if "who" in entry.facts:
                found.setdefault(str(entry.facts["who"]), []).append((key, entry))
    for entries in found.values():
        entries.sort(key=lambda item: str(item[1].facts["at"]), reverse=True)
    return found


def _digest(value: Any) -> str:
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:12]


NEWEST = 5
"""Earlier versions that are looked at for the nearest one."""
NAMED = 3
"""Changes of one kind that a reason names."""
_ABSENT = object()


class Reasons:
    """Finds the nearest earlier version of a node, and says what is different now."""

    def __init__(self, layout: Layout, index: ArtifactIndex, kinds: Sequence[str]) -> None:
        self._layout = layout
        self._versions = cache(lambda: versions(index, kinds))  # a plan in which nothing is missing never asks
        self._known: dict[tuple[object, ...], tuple[int, str]] = {}
        """By what was compared: nodes that share their configuration differ from versions that share theirs in the same way."""

    def of(self, node: Node) -> str | None:
        """Return what changed since the nearest version; None where there is none."""
        candidates = self._versions().get(who_is(node), [])[:NEWEST]
        found = [difference for key, entry in candidates if (difference := self._difference(node, key, entry)) is not None]
        return min(found, key=lambda item: item[0])[1] if found else None

    def beginning(self, node: Node) -> str | None:
        """Return the key of the stored cell with which this one begins: it has fewer episodes, and nothing else is different."""
        fewer = [
            (episodes, key)
            for key, entry in self._versions().get(who_is(node), [])
            if 0 < (episodes := entry.facts.get("episodes", 0)) < node.config["episodes"]
        ]
        return next((key for _, key in sorted(fewer, reverse=True) if self._begins(node, key)), None)

    def _begins(self, node: Node, key: str) -> bool:
        try:
            return _differs_in_episodes_alone(node, read_manifest(self._layout, node.kind, key))
        except (ArtifactError, KeyError, TypeError, ValueError, AttributeError):
            return False

    def _difference(self, node: Node, key: str, entry: Entry) -> tuple[int, str] | None:
        method = node.axes.get("method_config")
        # Identity is enough: the grid builds each of these once.
        pair = (entry.facts["signature"], id(node.config), id(node.settings), id(method), id(node.needs), node.modules)
        if pair not in self._known:
            try:
                self._known[pair] = _compared(node, read_manifest(self._layout, node.kind, key))
            except (ArtifactError, KeyError, TypeError, ValueError, AttributeError):
                return None
        return self._known[pair]


def _differs_in_episodes_alone(node: Node, manifest: Mapping[str, Any]) -> bool:
    before = [{**manifest["config"], "episodes": None}, *(manifest[name] for name in ("settings", "axes", "upstream"))]
    upstream = {name: needed.key for name, needed in node.needs.items()}
    now = [{**node.config, "episodes": None}, node.settings, node.axes, upstream]
    return canonical(before) == canonical(now) and not moved_on(node, manifest)


def _compared(node: Node, manifest: Mapping[str, Any]) -> tuple[int, str]:
    """How many things differ, and the words for them."""
    fields = list(_fields(node, manifest))
    modules, versions = _modules(source_hashes(node.modules), manifest["sources"]), library_changes(manifest)
    parts = _words(fields, modules, versions)
    if not parts:
        upstream = manifest["upstream"]
        parts = [f"upstream changed: {few([name for name, needed in node.needs.items() if upstream.get(name) != needed.key])}"]
    return len(fields) + len(modules) + len(versions), "; ".join(parts)


def _words(fields: Sequence[str], modules: Sequence[str], versions: Sequence[str]) -> list[str]:
    return [f"{what} changed: {few(items)}" for what, items in (("spec", fields), ("code", modules), ("library", versions)) if items]


def changes_between(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Return what differs between two versions of a node by their manifests: configuration, code and libraries, not what they read.

    Raises:
        AttributeError, KeyError, TypeError: a manifest is not as wasp writes it.
    """
    fields = _named(_differing(before["config"], after["config"], f"{after['kind']}."))
    fields += _differing(before["settings"], after["settings"], "")
    old, new = ((manifest["axes"].get("method_config") or {}) for manifest in (before, after))
    fields += _differing(old, new, f"{after['axes'].get('method')}.")
    older, newer = ((manifest["provenance"].get("versions") or {}) for manifest in (before, after))
    versions = _differing(older, newer, "")
    return _words(fields, _modules(after["sources"], before["sources"]), list(versions))


def moved_on(node: Node, manifest: Mapping[str, Any]) -> list[str]:
    """Return the modules and the libraries that have changed since a version of a node was computed."""
    return _modules(source_hashes(node.modules), manifest["sources"]) + library_changes(manifest)


def library_changes(manifest: Mapping[str, Any]) -> list[str]:
    """Return the libraries that an artifact was computed with in another version."""
    recorded = manifest["provenance"].get("versions")
    installed = recorded if isinstance(recorded, Mapping) else {}
    return [f"{name} {old} -> {new}" for name, new in libraries().items() if (old := _minor(installed.get(name))) != new]


def _fields(node: Node, manifest: Mapping[str, Any]) -> Iterator[str]:
    """Settings that differ, named as a spec names them."""
    model = stage_class(node.kind).config
    try:
        before, now = (model.model_validate(values).identity() for values in (manifest["config"], node.config))
    except ValidationError:  # written by a version with other fields
        before, now = dict(manifest["config"]), dict(node.config)
    yield from _named(_differing(before, now, f"{node.kind}."))
    yield from _differing(manifest["settings"], node.settings, "")
    method = str(node.axes.get("method"))
    yield from _differing(manifest["axes"].get("method_config") or {}, node.axes.get("method_config") or {}, f"{method}.")


def _named(changes: Iterable[str]) -> list[str]:
    """Settings as specs name them: `episodes` stands at the top."""
    return [text.removeprefix("evaluate.") if text.startswith("evaluate.episodes ") else text for text in changes]


def _differing(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str) -> Iterator[str]:
    for name in dict.fromkeys((*now, *before)):
        old, new = before.get(name, _ABSENT), now.get(name, _ABSENT)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from _differing(old, new, f"{prefix}{name}.")
        elif old != new and not (isinstance(old, list | tuple) and isinstance(new, list | tuple) and list(old) == list(new)):
            yield f"{prefix}{name} {_shown(old)} -> {_shown(new)}"


def _modules(now: Mapping[str, str], before: Mapping[str, str]) -> list[str]:
    changed = [name for name in now if before.get(name) != now[name]]
    return changed + [f"{name} (no longer used)" for name in before if name not in now]


def _minor(version: object) -> str:
    return ".".join(version.split(".")[:2]) if isinstance(version, str) else "absent"


def few(items: Sequence[str], most: int = NAMED) -> str:
    """Name at most so many of several things, and say how many more there are."""
    more = f" and {len(items) - most} more" if len(items) > most else ""
    return ", ".join(items[:most]) + more


def _shown(value: object) -> str:
    if value is _ABSENT:
        return "nothing"
    text = str(value)
    return text if len(text) <= 30 else text[:27] + "..."
