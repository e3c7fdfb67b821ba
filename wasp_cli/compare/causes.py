"""Why two results folders have other rows for one cell: what differs in its configuration, its code, its libraries, and upstream of it.

From the manifests alone, which may be untrusted; nothing is imported and no code of today is looked at.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.plan.reasons import changes_between, few
from wasp_cli.report.node import mapping
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout, is_key, is_name

MACHINE = ("processor", "platform", "python", "threads", "cuda")
"""Provenance that enters no key, and may move the last digits."""
DEEPEST = 50
"""Steps upstream; our longest chain has a dozen."""


class Causes:
    """Follows two artifacts upstream to where they begin to differ; every pair is looked at once."""

    def __init__(self, before: Layout, after: Layout) -> None:
        self._layouts = before, after
        self._known: dict[tuple[str, str, str], tuple[str, ...]] = {}

    def of(self, kind: str, before: str, after: str) -> tuple[str, ...]:
        """Say in words what differs between two artifacts that should be alike.

        Args:
            kind: of both.
            before: the key of the one.
            after: the key of the other; where it is the same, only the machine can differ.
        """
        return tuple(dict.fromkeys(self._machine(kind, before) if before == after else self._follow(kind, before, after, DEEPEST)))

    def _follow(self, kind: str, before: str, after: str, left: int) -> tuple[str, ...]:
        place = (kind, before, after)
        if place not in self._known:
            self._known[place] = ()  # a circle, which none of ours has, adds nothing
            self._known[place] = tuple(dict.fromkeys(self._changes(kind, before, after, left)))
        return self._known[place]

    def _changes(self, kind: str, before: str, after: str, left: int) -> Iterator[str]:
        try:
            old, new = self._manifest(0, kind, before), self._manifest(1, kind, after)
            own = changes_between(old, new)
        except (ArtifactError, StoreError):
            yield f"another {kind}, of which not both folders have the record"
            return
        except (AttributeError, KeyError, TypeError, ValueError):
            yield f"another {kind}, whose record is damaged"
            return
        yield from own
        upstream = list(_differing(old, new))
        for _, other, needed, needed_too in upstream if left else ():
            yield from self._follow(other, needed, needed_too, left - 1)
        reads = sorted({*mapping(old.get("upstream"))} ^ {*mapping(new.get("upstream"))})
        if reads:
            yield f"{kind}: reads other artifacts: {few(reads)}"
        if not own and not upstream and not reads:
            yield f"{kind}: another cell of the grid, or a key of another version"

    def _machine(self, kind: str, key: str) -> Iterator[str]:
        try:
            old, new = (mapping(self._manifest(side, kind, key).get("provenance")) for side in (0, 1))
        except (ArtifactError, StoreError):
            return
        versions = [mapping(each.get("versions")) for each in (old, new)]
        pairs = [(name, old.get(name), new.get(name)) for name in MACHINE]
        pairs += [(name, versions[0].get(name), versions[1].get(name)) for name in (*versions[0], *versions[1])]
        yield from (f"{name} {one} -> {two}" for name, one, two in dict.fromkeys(map(_shown, pairs)) if one != two)

    def _manifest(self, side: int, kind: str, key: str) -> Mapping[str, Any]:
        return read_manifest(self._layouts[side], kind, key)


def _shown(pair: tuple[str, Any, Any]) -> tuple[str, str, str]:
    name, one, two = pair
    return name, "unknown" if one is None else str(one), "unknown" if two is None else str(two)


def _differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    """What both read under one name, as another artifact: the name, the kind and both keys."""
    before, after, kinds = mapping(old.get("upstream")), mapping(new.get("upstream")), mapping(new.get("upstream_kinds"))
    for name, key in before.items():
        other, kind = after.get(name), kinds.get(name, name)
        if not (isinstance(key, str) and isinstance(other, str) and isinstance(kind, str)):
            continue
        if key != other and is_key(key) and is_key(other) and is_name(kind):
            yield name, kind, key, other
