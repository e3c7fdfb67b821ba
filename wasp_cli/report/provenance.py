"""Where the numbers of a report come from, as far as the store says.

The published results among its cells and what has changed in the code since, the versions that
cells were computed with, the values in force that the paper does not state, and whether files are
those that were stored.
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
    """Counts where the results of a report come from, from their manifests one after the other."""

    total: int = 0
    published: list[Mapping[str, Any]] = field(default_factory=list)
    versions: dict[str, Counter[str]] = field(default_factory=dict)
    """By name (commit, Python, processor, library): the number of cells with each version."""

    def add(self, manifest: Mapping[str, Any]) -> None:
        """Take the manifest of one more artifact into account."""
        self.total += 1
        if manifest.get("kind") == KIND:
            for name, version in _versions(manifest):
                self.versions.setdefault(name, Counter())[version] += 1
        if is_from_published(manifest):
            self.published.append(manifest)

    def facts(self) -> Iterator[str]:
        """Yield sentences about the published results: how many, of which version and days, what
        has changed in their code and libraries since, and which cells they are.
        """
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
            since = "their own code and libraries are the present ones"
            if changes:
                since = f"changed since then: {few(list(dict.fromkeys(changes)))}"
            yield (
                f"{len(manifests)} of {self.total} results here are published ones ({counted}), "
                f"computed by wasp {version}{commit} {_when(manifests)}; {since}."
            )
        cells = [
            str(manifest.get("label"))
            for manifest in self.published
            if manifest.get("kind") == "evaluate"
        ]
        if 0 < len(self.published) < self.total and cells:
            yield f"Published cells: {few(cells, NAMED)}."

    def remarks(self) -> Iterator[str]:
        """Yield a sentence if cells were computed with different commits, Pythons, libraries or
        processors, which their keys do not contain.
        """
        mixed = []
        for name, counts in self.versions.items():
            if len(counts) > 1:
                parts = []
                for version, count in counts.most_common():
                    cells = "1 cell" if count == 1 else f"{count} cells"
                    parts.append(f"{version} ({cells})")
                mixed.append(f"{name} {', '.join(parts)}")
        if mixed:
            yield f"The cells were not computed with the same versions: {'; '.join(mixed)}."


def _of_different_code(manifests: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The first manifest of each version of code and libraries: hundreds of cells share one."""
    first: dict[str, Mapping[str, Any]] = {}
    for manifest in manifests:
        code = repr((manifest.get("sources"), manifest["provenance"].get("versions")))
        first.setdefault(code, manifest)
    return list(first.values())


def _versions(manifest: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Names and versions of what a cell was computed with."""
    provenance = manifest["provenance"]
    git = provenance.get("git")
    if isinstance(git, Mapping) and isinstance(git.get("sha"), str):
        commit = git["sha"][:SHA_LENGTH]
        if git.get("dirty"):
            changes = str(git.get("changes") or "")[:SHA_LENGTH]
            commit = f"{commit} with changes {changes}".rstrip()
        yield "commit", printable(commit)
    python = provenance.get("python")
    if isinstance(python, str):
        yield "Python", printable(python)
    processor = provenance.get("processor")
    if isinstance(processor, str):
        yield "processor", printable(processor.partition(",")[0])
    libraries = provenance.get("versions")
    if isinstance(libraries, Mapping):
        for name, version in libraries.items():
            yield printable(str(name)), printable(str(version))


def is_from_published(manifest: Mapping[str, Any]) -> bool:
    """Return whether an artifact was taken from published results rather than computed here."""
    return manifest["provenance"].get(FROM_PUBLISHED) is True


def _when(manifests: Sequence[Mapping[str, Any]]) -> str:
    times = [manifest["provenance"].get("started_at") for manifest in manifests]
    days = sorted({time[: len("2026-01-01")] for time in times if isinstance(time, str)})
    if not days:
        return "at an unknown time"
    return f"on {days[0]}" if len(days) == 1 else f"from {days[0]} to {days[-1]}"


def _modules(manifest: Mapping[str, Any]) -> dict[str, str]:
    """The hash of each module. Names that are not dotted identifiers are left out: a manifest may
    be untrusted, and a name is looked up as a path.
    """
    sources = manifest.get("sources")
    if not isinstance(sources, Mapping):
        return {}
    return {
        name: str(digest)
        for name, digest in sources.items()
        if all(part.isidentifier() for part in name.split("."))
    }


# cells that a page lists at most; `wasp_cli.results` finds any cell of a larger grid
MOST_CELLS = 500


def cell_sources(layout: Layout, cells: CellTable) -> list[tuple[str, int, str, str, str]]:
    """Return label, episodes, day, commit and key of each cell of a report. Day and commit are
    empty if they are unknown.

    A report with more than MOST_CELLS cells lists none.
    """
    if len(cells) > MOST_CELLS:
        return []
    sources = []
    for cell, count in zip(cells, cells.counts.tolist(), strict=True):
        try:
            manifest = read_manifest(layout, KIND, cell.key)
            provenance = manifest["provenance"]
            label = _text(manifest["label"])
            day = _text(provenance.get("started_at"))[: len("2026-01-01")]
            git = provenance.get("git")
        except (ArtifactError, KeyError, AttributeError):
            # of another version, or damaged; the report says so elsewhere
            continue
        commit = ""
        if isinstance(git, Mapping):
            commit = _text(git.get("sha"))[:SHA_LENGTH]
        sources.append((label, count, day, commit, cell.key))
    return sources


def _text(value: Any) -> str:
    """A printable text; an empty one instead of anything else."""
    return printable(value) if isinstance(value, str) else ""


def absent_parts(
    layout: Layout, parts: Sequence[tuple[Part, str]], targets: Sequence[str]
) -> list[Part]:
    """Return the trained parts that are not there and that nothing needs. There are none if the
    spec trains a stage of theirs by name (`targets`).
    """
    absent = [part for part, key in parts if not layout.manifest(part.kind, key).is_file()]
    if any(part.kind in targets for part in absent):
        return []
    return absent


# An assumption that has no setting: operators, filter and task share no random stream that a
# sample could be drawn from.
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
"""What section 4 of the paper leaves open and no setting covers."""


def assumptions_in_force(spec: Spec) -> list[Assumption]:
    """Return the values in force that the paper does not state or that differ from it, as (dotted
    name, value, why); those that differ come first.

    Only sections that the methods of the spec need are listed, and tasks with values of their own.
    """
    # The kinds of nodes that the spec needs, with all that they need in turn.
    needed = [*spec.stages]
    for method in spec.methods:
        info = METHODS[method]
        needed.append("evaluate")
        needed += info.needs_of(spec.method(method).model_dump(mode="json"))
        if info.calibrated:
            needed.append("calibration")
        if any(spec.chooses_point(task, method) for task in spec.tasks):
            needed.append("operating")
    if spec.chooses_severities:
        needed.append("severity")
    kinds: set[str] = set()
    while needed:
        kind = needed.pop()
        if kind not in kinds:
            kinds.add(kind)
            needed += stage_class(kind).needs

    # The assumptions of all sections but those that nothing uses.
    in_force: list[Assumption] = []
    for name, value, why in [*assumptions(spec), *_of_single_tasks(spec)]:
        section = name.partition(".")[0] if "." in name else ""
        if section in STAGES:
            is_used = section in kinds
        else:
            is_used = section not in METHODS or section in spec.methods
        if is_used:
            in_force.append((name, value, why))
    if "world_model" in kinds:
        in_force.append(POSTERIOR)
    if {"wasp", "printed"} & {*spec.methods}:
        in_force += READINGS
    return sorted(in_force, key=lambda one: not one[2].startswith(DIFFERS))


def _of_single_tasks(spec: Spec) -> list[Assumption]:
    """The assumptions of sections that a task sets for itself, where they differ."""
    differing: list[Assumption] = []
    for task in spec.tasks:
        for section in spec.by_task.get(task, {}):
            section_of = spec.stage if section in STAGES else spec.method
            common = {name: value for name, value, _ in assumptions(section_of(section))}
            for name, value, why in assumptions(section_of(section, task=task)):
                if name not in common or common[name] != value:
                    differing.append((f"{section}.{name}", value, f"{why} (on {task} alone)"))
    return differing


def assumptions_markdown(assumed: Sequence[Assumption]) -> str:
    """Return the section with the table of assumptions as Markdown."""
    lines = [
        "## Assumptions in force",
        "",
        "Values that differ from the paper, then those that it leaves open. A spec can change "
        "each one that is a setting.",
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
    """Compare the SHA-256 of every file of some artifacts (kind and key) with their manifests.
    Artifacts that are not there are passed over.

    Returns:
        How many artifacts were read, and a sentence for each that differs.
    """
    read = 0
    wrong = []
    for kind, key in dict.fromkeys(artifacts):
        try:
            if not layout.within(layout.manifest(kind, key)).is_file():
                continue
            problem = corruption(layout, kind, key)
        except (ArtifactError, StoreError) as error:
            problem = error.message
        except (OSError, AttributeError) as error:  # it is being changed, or names no digests
            problem = f"'{layout.artifact(kind, key)}': {error}"
        read += 1
        if problem is not None:
            wrong.append(problem)
    return read, wrong
