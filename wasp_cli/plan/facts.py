"""What a plan reads in manifests: how long nodes of a sort took, and which earlier version of a node there is."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from statistics import median
from typing import Any

from wasp_cli.plan.keys import canonical
from wasp_cli.plan.node import Node, sort_of
from wasp_cli.store.index import ArtifactIndex, Entry

VERSION = 1
"""Raised when `facts_of` changes."""


def facts_of(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """What the index of a store keeps of a manifest.

    `who` is the same for all versions of one node; `sort` is `Node.sort`; `signature` is the same for versions which differ from a node in
    the same way; `seconds` is what it took, `at` when that was.
    """
    provenance = manifest["provenance"]
    axes = manifest["axes"]
    differing = [manifest[name] for name in ("config", "settings", "sources", "upstream")]
    return {
        "who": who(str(manifest["kind"]), str(manifest["task"]), int(manifest["seed"]), axes),
        "sort": sort_of(manifest["kind"], manifest["task"], manifest["config"], axes),
        "signature": _digest([*differing, axes.get("method_config"), provenance.get("versions")]),
        "seconds": float(provenance["seconds"]),
        "at": str(provenance.get("started_at", "")),
    }


def who(kind: str, task: str, seed: int, axes: Mapping[str, Any]) -> str:
    """The identity of a node without its configuration: who assists whom, where, with which seed, in which round."""
    method = axes.get("method_config")
    variant = method.get("variant") if isinstance(method, Mapping) else None
    # By hand: this is asked of every node of a grid.
    return f"{kind} {task} {seed} {axes.get('round')} {axes.get('method')} {variant} {axes.get('variant')} {axes.get('value')!r}"


def who_is(node: Node) -> str:
    """`who` of a node."""
    return who(node.kind, node.task, node.seed, node.axes)


def measured(index: ArtifactIndex) -> dict[str, float]:
    """Median seconds by sort of node."""
    times: dict[str, list[float]] = {}
    for entries in index.whole.values():
        for entry in entries.values():
            if "seconds" in entry.facts:
                times.setdefault(str(entry.facts["sort"]), []).append(float(entry.facts["seconds"]))
    return {sort: median(values) for sort, values in times.items()}


def versions(index: ArtifactIndex, kinds: Iterable[str]) -> dict[str, list[tuple[str, Entry]]]:
    """By `who`, the key and the entry of every version in the store, newest first."""
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
