"""Which of the results in a report were published, and how far the code has moved on since: said from the store alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wasp_cli.plan.closure import changed_since
from wasp_cli.plan.node import Part
from wasp_cli.plan.reasons import few, library_changes
from wasp_cli.store.layout import Layout
from wasp_cli.store.published import FROM_PUBLISHED, commit_of

NAMED = 12
"""Published cells that a report names."""


@dataclass
class Origins:
    """Counts the artifacts of a report, and keeps the manifests of those that were published."""

    total: int = 0
    published: list[Mapping[str, Any]] = field(default_factory=list)

    def add(self, manifest: Mapping[str, Any]) -> None:
        """Take one more artifact into account."""
        self.total += 1
        if is_from_published(manifest):
            self.published.append(manifest)

    def facts(self) -> Iterator[str]:
        """One sentence for each version that computed published results, and which cells these are where not all are."""
        versions: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
        for manifest in self.published:
            version = str(manifest["provenance"].get("wasp", "of an unknown version"))
            versions.setdefault((version, commit_of(manifest)), []).append(manifest)
        for (version, commit), manifests in versions.items():
            kinds = Counter(str(manifest.get("kind")) for manifest in manifests)
            counted = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
            results = f"{len(manifests)} of {self.total} results here are published ones ({counted})"
            yield f"{results}, computed by wasp {version}{commit} {_when(manifests)}; {_code_since(manifests)}."
        cells = [str(manifest.get("label")) for manifest in self.published if manifest.get("kind") == "evaluate"]
        if 0 < len(self.published) < self.total and cells:
            more = f" and {len(cells) - NAMED} more" if len(cells) > NAMED else ""
            yield f"Published cells: {', '.join(cells[:NAMED])}{more}."


def is_from_published(manifest: Mapping[str, Any]) -> bool:
    """Whether an artifact of the store was brought in from the published layer."""
    return manifest["provenance"].get(FROM_PUBLISHED) is True


def _when(manifests: Sequence[Mapping[str, Any]]) -> str:
    times = [manifest["provenance"].get("started_at") for manifest in manifests]
    days = sorted({time[: len("2026-01-01")] for time in times if isinstance(time, str)})
    if not days:
        return "at an unknown time"
    return f"on {days[0]}" if len(days) == 1 else f"from {days[0]} to {days[-1]}"


def _code_since(manifests: Sequence[Mapping[str, Any]]) -> str:
    changes: dict[str, None] = {}
    for manifest in manifests:
        changes |= dict.fromkeys([*changed_since(_modules(manifest)), *library_changes(manifest)])
    return f"since then has changed: {few(list(changes))}" if changes else "their code and libraries are those of today"


def _modules(manifest: Mapping[str, Any]) -> dict[str, str]:
    """Hash by module; a name that is none, which untrusted files may hold, would be looked up as a path."""
    sources = manifest.get("sources")
    known = sources.items() if isinstance(sources, Mapping) else ()
    return {name: str(known_hash) for name, known_hash in known if all(part.isidentifier() for part in name.split("."))}


def absent_parts(layout: Layout, parts: Sequence[tuple[Part, str]], targets: Sequence[str]) -> list[Part]:
    """The trained parts that are not there, and that nothing needs: what a spec trains by name is there, as its cells are.

    Args:
        layout: the results folder.
        parts: what a run trains, each with the key of its artifact.
        targets: the stages that the spec names.
    """
    absent = [part for part, key in parts if not layout.manifest(part.kind, key).is_file()]
    return [] if any(part.kind in targets for part in absent) else absent


def absent_fact(absent: Sequence[Part]) -> str:
    """Why parts are not there."""
    kinds = ", ".join(dict.fromkeys(part.kind for part in absent))
    return f"{len(absent)} trained parts were not computed, since published results were used in place of what reads them: {kinds}."
