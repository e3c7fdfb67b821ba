"""Why two artifacts that should be alike differ, from their manifests alone.

Manifests may be untrusted; nothing is imported and no code of today is looked at.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.plan.reasons import changes_between, few
from wasp_cli.report.node import mapping, upstream_of
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout

# provenance that enters no key, and may move the last digits
MACHINE = ("processor", "platform", "python", "threads", "cuda")


class Causes:
    """Follows two artifacts upstream to where they begin to differ; every pair is looked at
    once.
    """

    def __init__(self, before: Layout, after: Layout) -> None:
        self._layouts = (before, after)
        self._known: dict[tuple[str, str, str], tuple[str, ...]] = {}

    def of(self, kind: str, before: str, after: str) -> tuple[str, ...]:
        """Say in words what differs between two artifacts that should be alike; of the same key
        only the machine can differ.
        """
        return tuple(
            dict.fromkeys(
                self._machine(kind, before)
                if before == after
                else self._follow(kind, before, after)
            )
        )

    def _follow(self, kind: str, before: str, after: str) -> tuple[str, ...]:
        place = (kind, before, after)
        if place not in self._known:
            self._known[place] = ()  # a circle, which none of ours has, adds nothing
            self._known[place] = tuple(dict.fromkeys(self._changes(kind, before, after)))
        return self._known[place]

    def _changes(self, kind: str, before: str, after: str) -> Iterator[str]:
        try:
            old = read_manifest(self._layouts[0], kind, before)
            new = read_manifest(self._layouts[1], kind, after)
            own = changes_between(old, new)
        except (ArtifactError, StoreError):
            yield f"another {kind}, of which not both folders have the record"
            return
        except (AttributeError, KeyError, TypeError, ValueError):
            yield f"another {kind}, whose record is damaged"
            return
        yield from own

        # What both read under one name, in two versions.
        first = upstream_of(old)
        second = upstream_of(new)
        differs_upstream = False
        for name, (_, key_before) in first.items():
            if name not in second:
                continue
            kind_after, key_after = second[name]
            if key_before != key_after:
                differs_upstream = True
                yield from self._follow(kind_after, key_before, key_after)

        # What one of them reads alone.
        reads = sorted({*mapping(old.get("upstream"))} ^ {*mapping(new.get("upstream"))})
        if reads:
            yield f"{kind}: reads other artifacts: {few(reads)}"
        if not own and not differs_upstream and not reads:
            yield f"{kind}: another cell of the grid, or a key of another version"

    def _machine(self, kind: str, key: str) -> Iterator[str]:
        try:
            manifests = [read_manifest(layout, kind, key) for layout in self._layouts]
        except (ArtifactError, StoreError):
            return
        machines = [mapping(each.get("provenance")) for each in manifests]
        libraries = [mapping(each.get("versions")) for each in machines]
        yield from _differences(machines[0], machines[1], MACHINE)
        every_library = dict.fromkeys((*libraries[0], *libraries[1]))
        yield from _differences(libraries[0], libraries[1], every_library)


def _differences(
    old: Mapping[str, Any], new: Mapping[str, Any], names: Iterable[str]
) -> Iterator[str]:
    """The facts of these names that differ."""
    for name in names:
        before = str(old.get(name) or "unknown")
        after = str(new.get(name) or "unknown")
        if before != after:
            yield f"{name} {before} -> {after}"
