"""What stands behind the numbers of a report, said from the store alone.

The runs that it is about, the published results among its cells and how far the code has moved on
since, and the values in force that the paper does not state; and whether the files are those that
were stored.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wasp_cli.cells.table import CellTable
from wasp_cli.config import DIFFERS, assumptions
from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.grid import stage_class
from wasp_cli.plan.node import Part
from wasp_cli.plan.reasons import few, library_changes
from wasp_cli.plan.source import changed_since
from wasp_cli.report.render import markdown_row
from wasp_cli.spec.model import Spec
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.artifact import corruption, read_manifest
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import printable
from wasp_cli.store.published import FROM_PUBLISHED, SHA_LENGTH, commit_of

NAMED = 12  # published cells that a report names

Assumption = tuple[str, Any, str]  # dotted name, value, why


@dataclass
class Origins:
    total: int = 0
    published: list[Mapping[str, Any]] = field(default_factory=list)
    versions: dict[str, Counter[str]] = field(default_factory=dict)
    """By what it is, the number of cells that were computed with each version of it."""

    def add(self, manifest: Mapping[str, Any]) -> None:
        self.total += 1
        if manifest.get("kind") == KIND:
            for name, version in _versions(manifest):
                self.versions.setdefault(name, Counter())[version] += 1
        if is_from_published(manifest):
            self.published.append(manifest)

    def facts(self) -> Iterator[str]:
        versions: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
        for manifest in self.published:
            version = str(manifest["provenance"].get("wasp", "of an unknown version"))
            versions.setdefault((version, commit_of(manifest)), []).append(manifest)
        for (version, commit), manifests in versions.items():
            kinds = Counter(str(manifest.get("kind")) for manifest in manifests)
            counted = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
            changes = [
                change
                for manifest in _of_different_code(manifests)
                for change in (*changed_since(_modules(manifest)), *library_changes(manifest))
            ]
            since = f"since then has changed: {few(list(dict.fromkeys(changes)))}"
            since = since if changes else "their own code and libraries are the present ones"
            results = (
                f"{len(manifests)} of {self.total} results here are published ones ({counted})"
            )
            yield f"{results}, computed by wasp {version}{commit} {_when(manifests)}; {since}."
        cells = [
            str(manifest.get("label"))
            for manifest in self.published
            if manifest.get("kind") == "evaluate"
        ]
        if 0 < len(self.published) < self.total and cells:
            yield f"Published cells: {few(cells, NAMED)}."

    def remarks(self) -> Iterator[str]:
        """Yield what the keys of cells do not tell apart."""
        mixed = {name: counts for name, counts in self.versions.items() if len(counts) > 1}
        if mixed:
            said = [
                f"{name} "
                + ", ".join(
                    f"{version} ({count} cell{'s' if count > 1 else ''})"
                    for version, count in counts.most_common()
                )
                for name, counts in mixed.items()
            ]
            yield f"The cells were not computed with the same versions: {'; '.join(said)}."


def _of_different_code(manifests: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The first manifest of each version of code and libraries: hundreds of cells share one."""
    first: dict[str, Mapping[str, Any]] = {}
    for manifest in manifests:
        code = repr((manifest.get("sources"), manifest["provenance"].get("versions")))
        first.setdefault(code, manifest)
    return list(first.values())


def _versions(manifest: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    provenance = manifest["provenance"]
    git, python, libraries, processor = (
        provenance.get(name) for name in ("git", "python", "versions", "processor")
    )
    if isinstance(git, Mapping) and isinstance(git.get("sha"), str):
        changes = (
            f" with changes {str(git.get('changes') or '')[:SHA_LENGTH]}".rstrip()
            if git.get("dirty")
            else ""
        )
        yield "commit", printable(f"{git['sha'][:SHA_LENGTH]}{changes}")
    if isinstance(python, str):
        yield "Python", printable(python)
    if isinstance(processor, str):
        yield "processor", printable(processor.partition(",")[0])
    for name, version in (libraries if isinstance(libraries, Mapping) else {}).items():
        yield printable(str(name)), printable(str(version))


def is_from_published(manifest: Mapping[str, Any]) -> bool:
    return manifest["provenance"].get(FROM_PUBLISHED) is True


def _when(manifests: Sequence[Mapping[str, Any]]) -> str:
    times = [manifest["provenance"].get("started_at") for manifest in manifests]
    days = sorted({time[: len("2026-01-01")] for time in times if isinstance(time, str)})
    if not days:
        return "at an unknown time"
    return f"on {days[0]}" if len(days) == 1 else f"from {days[0]} to {days[-1]}"


def _modules(manifest: Mapping[str, Any]) -> dict[str, str]:
    """Hash by module; a name that is none, which untrusted files may hold, would be looked up
    as a path.
    """
    sources = manifest.get("sources")
    known = sources.items() if isinstance(sources, Mapping) else ()
    return {
        name: str(known_hash)
        for name, known_hash in known
        if all(part.isidentifier() for part in name.split("."))
    }


# a page lists as many cells at most: in a grid of thousands nobody reads them, and
# `wasp_cli.results` finds any
MOST_CELLS = 500


def cell_sources(layout: Layout, cells: CellTable) -> list[tuple[str, int, str, str, str]]:
    """Read label, episodes, day, commit and key of each cell of a report; none of them where there
    are too many to list.

    Day and commit are empty where they are unknown.
    """
    if len(cells) > MOST_CELLS:
        return []
    sources = []
    for cell, count in zip(cells, cells.counts.tolist(), strict=True):
        try:
            manifest = read_manifest(layout, KIND, cell.key)
            provenance = manifest["provenance"]
            label, day, git = manifest["label"], provenance.get("started_at"), provenance.get("git")
        except (ArtifactError, KeyError, AttributeError):
            # of another version, or damaged, as the report says elsewhere
            continue
        sha = git.get("sha") if isinstance(git, Mapping) else None
        shown, when, commit = (
            printable(each) if isinstance(each, str) else "" for each in (label, day, sha)
        )
        sources.append((shown, count, when[: len("2026-01-01")], commit[:SHA_LENGTH], cell.key))
    return sources


def absent_parts(
    layout: Layout, parts: Sequence[tuple[Part, str]], targets: Sequence[str]
) -> list[Part]:
    """List the trained parts that are not there, and that nothing needs: what a spec trains by
    name is there, as its cells are.
    """
    absent = [part for part, key in parts if not layout.manifest(part.kind, key).is_file()]
    return [] if any(part.kind in targets for part in absent) else absent


# an assumption that cannot be a choice: operators, filter and task share no random stream that a
# sample could come from
POSTERIOR = (
    "the filter",
    "mode",
    "no setting: z_t is the mode of the posterior q(z_t | h_t, o_t), not a sample, so that "
    "filtering draws nothing and all methods see "
    "the same latent",
)
READINGS = (
    (
        "wasp: an ended episode",
        "gamma p",
        "no setting: Eq. 8 has no ends; gamma is multiplied by the probability that the imagined "
        "episode goes on",
    ),
    (
        "wasp: step k",
        "k + 1",
        "no setting: reward and cost of an imagined step are read at the state that it arrives in",
    ),
    (
        "wasp: residuals",
        "[-2, 2]",
        "no setting: samples are cut where a residual to a command within ±1 stops making "
        "a difference",
    ),
)
"""What section 4 leaves to the reader, and no field says."""


def assumptions_in_force(spec: Spec) -> list[Assumption]:
    needed = [*spec.stages]
    for method in spec.methods:
        info, config = METHODS[method], spec.method(method).model_dump(mode="json")
        needed += ["evaluate", *info.needs_of(config), *["calibration"] * info.calibrated]
        if any(spec.chooses_point(task, method) for task in spec.tasks):
            needed.append("operating")
    if spec.chooses_severities:
        needed.append("severity")
    kinds: set[str] = set()
    while needed:
        if (kind := needed.pop()) not in kinds:
            kinds.add(kind)
            needed += stage_class(kind).needs
    in_force: list[Assumption] = []
    for name, value, why in [*assumptions(spec), *_of_single_tasks(spec)]:
        section = name.partition(".")[0] if "." in name else ""
        idle = (
            section not in kinds
            if section in STAGES
            else section in METHODS and section not in spec.methods
        )
        if not idle:
            in_force.append((name, value, why))
    if "world_model" in kinds:
        in_force.append(POSTERIOR)
    if {"wasp", "printed"} & {*spec.methods}:
        in_force += READINGS
    return sorted(in_force, key=lambda one: not one[2].startswith(DIFFERS))


def _of_single_tasks(spec: Spec) -> list[Assumption]:
    differing: list[Assumption] = []
    for task in spec.tasks:
        for section in spec.by_task.get(task, {}):
            base, own = (
                (spec.stage if section in STAGES else spec.method)(section, task=which)
                for which in (None, task)
            )
            same = {name: value for name, value, _ in assumptions(base)}
            differing += [
                (f"{section}.{name}", value, f"{why} (on {task} alone)")
                for name, value, why in assumptions(own)
                if name not in same or same[name] != value
            ]
    return differing


def assumptions_markdown(assumed: Sequence[Assumption]) -> str:
    said = (
        "Values that differ from the paper, then those that it leaves open. A spec can change "
        "each that is a setting."
    )
    lines = [
        "## Assumptions in force",
        "",
        said,
        "",
        "| Field | Value | Why |",
        "| --- | --- | --- |",
    ]
    for name, value, why in assumed:
        lines.append(
            markdown_row(
                (f"`{name}`", f"`{json.dumps(value, default=str, ensure_ascii=False)}`", why)
            )
        )
    return "\n".join(lines) + "\n"


def altered(layout: Layout, artifacts: Iterable[tuple[str, str]]) -> tuple[int, list[str]]:
    """Compare the SHA-256 of every file of artifacts (kind and key) with their manifests; those
    that are not there are left out.

    Returns how many were read, and what is wrong with each that differs.
    """
    read, wrong = 0, []
    for kind, key in dict.fromkeys(artifacts):
        try:
            if not layout.within(layout.manifest(kind, key)).is_file():
                continue
            problem = corruption(layout, kind, key)
        except (ArtifactError, StoreError) as error:
            problem = error.message
        except (OSError, AttributeError) as error:  # it changes now, or names no digests
            problem = f"'{layout.artifact(kind, key)}': {error}"
        read += 1
        if problem is not None:
            wrong.append(problem)
    return read, wrong
