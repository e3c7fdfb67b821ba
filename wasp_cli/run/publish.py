"""`wasp publish`: copies results to the published layer, which is kept in git and read by anyone.

The copies are undamaged and small, and say where they came from without naming a person's machine.
"""

from __future__ import annotations

import json
import math
import os
import platform
import re
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.text import Text

import wasp_cli
from wasp_cli.cells.runs import planned_run, run_ids
from wasp_cli.console import count_table, out, say, size, waiting_aloud
from wasp_cli.errors import ArtifactError, UsageError, first
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import Step, plan_against
from wasp_cli.plan.reuse import lay_out_over, recipes_in
from wasp_cli.plan.selection import select
from wasp_cli.spec.model import Spec
from wasp_cli.stages.registry import STAGES
from wasp_cli.store import artifact, records
from wasp_cli.store.layout import Layout, is_name
from wasp_cli.store.lock import held
from wasp_cli.store.packs import FOLDER, write_pack
from wasp_cli.store.published import BEHIND, EARLIER, RECIPE, copy_files
from wasp_cli.store.slim import SLIM, Slimming, slim, steps_kept
from wasp_cli.tasks.registry import TASKS

PUBLIC = (
    "wasp",
    "git",
    "python",
    "versions",
    "platform",
    "processor",
    "cores",
    "memory_gb",
    "threads",
    "cuda",
    "started_at",
    "seconds",
    EARLIER,
)
"""The part of the provenance that a published manifest keeps. The host, the command, the run and
the log are left out.
"""
SHORTEST = 4  # characters of a private name: shorter ones are found everywhere by chance
STAGED = "publish"  # the folder in `tmp/` where copies are made
NAMED = 12  # nodes that an error names


@dataclass(frozen=True)
class Item:
    """An artifact that can be published."""

    node: Node
    source: Layout  # where it lies
    size: int
    manifest: Mapping[str, Any]  # as it will be published


@dataclass(frozen=True)
class Publication:
    """What is published of a spec, and what is left out."""

    new: tuple[Item, ...]
    there: tuple[Item, ...]  # those that the published layer has already, byte for byte
    large: tuple[Item, ...]  # left out because of their size
    absent: tuple[Node, ...]  # not computed because nothing needs them
    reports: tuple[Path, ...]
    other: bool  # whether the report is left out, since it is of another run


def publication(
    spec: Spec, layout: Layout, target: Layout, selectors: Sequence[str], largest: float, reuse: str
) -> Publication:
    """Return what of a spec can be published, and what is left out; nothing is written.

    Args:
        target: the published layer, or a folder that becomes one.
        selectors: those of `--select`; none: everything.
        largest: bytes that an artifact may have.
        reuse: as for `wasp run`; `none` for results of this code only.

    Raises:
        UsageError: `target` is a folder with something else.
        ArtifactError: a result is not computed, is damaged, or names this machine.
    """
    if not all(recipes_in(target)):
        raise UsageError(
            f"'{target.root}' is no folder of published results",
            "name a new folder, or one that wasp publish has filled",
        )
    grid = lay_out_over(spec, layout, reuse)
    selected = select(grid, selectors)
    plan = plan_against(grid, layout, wanted=selected)
    steps = [step for step in plan.steps if selected is None or step.node.key in selected]

    # What there is: of the right size, and not published yet.
    items = _candidates(grid, steps, layout, target)
    small = [item for item in items if item.size <= largest]
    there = [
        item for item in small if artifact.corruption(target, item.node.kind, item.node.key) is None
    ]
    new = [item for item in small if item not in there]
    reports = _reports(spec, grid, layout, target)

    # What must not be published.
    refusals = _refusals(steps, layout, target)
    private = _private(layout)
    for item in new:
        why = _why_not(item, private)
        if why is not None:
            refusals.append(f"{item.node.label}: {why}")
    for path in reports.new:
        named = _named(path.read_bytes(), private)
        if named is not None:
            refusals.append(f"'{path}': it names {named}")
    if refusals:
        message = f"{len(refusals)} results cannot be published:"
        lines = first([f"  {text}" for text in refusals], NAMED)
        hint = None
        if any(": it names " not in text for text in refusals):
            hint = "wasp run SPEC --reuse none computes what is missing, with this code"
        raise ArtifactError("\n".join([message, *lines]), hint)

    return Publication(
        new=tuple(new),
        there=tuple(there),
        large=tuple(item for item in items if item.size > largest),
        absent=tuple(step.node for step in steps if step.state == "unneeded"),
        reports=reports.new,
        other=reports.of_another_run,
    )


def _candidates(grid: Grid, steps: Sequence[Step], layout: Layout, target: Layout) -> list[Item]:
    """What is in the store or in the published layer, of any size."""
    behind = _behind(grid)
    items = []
    for step in steps:
        node = step.node
        if step.state == "cached":
            items.append(_item(node, layout, behind[node.key]))
        elif step.state == "published" and _is_in(target, node):
            items.append(_item(node, target, behind[node.key]))
    return items


def _refusals(steps: Sequence[Step], layout: Layout, target: Layout) -> list[str]:
    """Why nodes are neither in the store nor in the published layer, a sentence each."""
    missing = [f"{step.node.label}: {step.reason}" for step in steps if step.runs]
    elsewhere = [
        f"{step.node.label}: it was published elsewhere, and is not in '{layout.root}'"
        for step in steps
        if step.state == "published" and not _is_in(target, step.node)
    ]
    return missing + elsewhere


def _is_in(target: Layout, node: Node) -> bool:
    return artifact.damage(target, node.kind, node.key) is None


@dataclass(frozen=True)
class _Reports:
    new: tuple[Path, ...]  # files with other bytes than those that are published
    of_another_run: bool  # whether what is here is of another run than what is published


def _reports(spec: Spec, grid: Grid, layout: Layout, target: Layout) -> _Reports:
    """The files of the spec's report, if it is that of its newest run."""
    folder = layout.within(layout.reports(spec.name))
    written = [
        path
        for path in sorted(folder.glob("*"))
        if is_name(path.name) and path.is_file() and not path.is_symlink()
    ]
    if written and not _is_of_last_run(spec, grid, layout):
        return _Reports((), of_another_run=True)
    published = {
        path.name: path.read_bytes()
        for path in target.reports(spec.name).glob("*")
        if path.is_file()
    }
    new = [path for path in written if published.get(path.name) != path.read_bytes()]
    return _Reports(tuple(new), of_another_run=False)


def _is_of_last_run(spec: Spec, grid: Grid, layout: Layout) -> bool:
    """Whether the report here is about the nodes of `grid`. Until the newest run has written its
    report, the report of an earlier run is there.
    """
    for run_id in run_ids(layout):  # newest first
        run = planned_run(layout, run_id)
        if run is not None and run.spec == spec.name:
            same = run.nodes.keys() == {node.key for node in grid.nodes}
            return same and not layout.reporting(run_id).exists()
    return False


def _item(node: Node, source: Layout, behind: Mapping[str, str]) -> Item:
    manifest = artifact.read_manifest(source, node.kind, node.key)
    size = sum(artifact.listed_files(manifest, source.manifest(node.kind, node.key)).values())
    provenance = {name: value for name, value in manifest["provenance"].items() if name in PUBLIC}
    return Item(
        node,
        source,
        size,
        {**manifest, "provenance": provenance, RECIPE: node.recipe, BEHIND: behind},
    )


def _behind(grid: Grid) -> dict[str, dict[str, str]]:
    """By key of a node, the keys of everything that it was computed from, by recipe."""
    behind: dict[str, dict[str, str]] = {}
    for node in grid.nodes:  # needed ones first
        if node.key in grid.reused:
            behind[node.key] = dict(grid.reused[node.key].offer.behind)
        else:
            behind[node.key] = {}
            for needed in node.needs.values():
                behind[node.key] |= behind[needed.key] | {needed.recipe: needed.key}
    return behind


def _why_not(item: Item, private: Mapping[str, str]) -> str | None:
    """Why an artifact must not be published: it is damaged, or names something private."""
    kind = item.node.kind
    key = item.node.key
    wrong = artifact.corruption(item.source, kind, key)
    if wrong is not None:
        return wrong
    folder = item.source.artifact(kind, key)
    texts = [
        records.dumps(item.manifest).encode(),
        *((folder / name).read_bytes() for name in item.manifest["files"]),
    ]
    for text in texts:
        named = _named(text, private)
        if named is not None:
            return f"it names {named}"
    return None


def _private(layout: Layout) -> dict[str, str]:
    """Texts that must not be published, by what they are: paths on this machine, and its name."""
    checkout = Path(wasp_cli.__file__).resolve().parents[1]
    named = {
        "the results folder": str(layout.root),
        "the results folder behind a link": str(layout.root.resolve()),
        "the folder of the source": str(checkout),
        # "~" for an account without one, which is too short to be looked for
        "the home folder": os.path.expanduser("~"),
        "this machine": platform.node(),
    }
    # A machine with such a name cannot be recognized by it.
    words = {"localhost", "wasp", *METHODS, *OPERATORS, *TASKS, *STAGES}
    return {
        what: text for what, text in named.items() if len(text) >= SHORTEST and text not in words
    }


def _named(data: bytes, private: Mapping[str, str]) -> str | None:
    """What private text a file contains; None if none."""
    for what, text in private.items():
        # JSON escapes what is not ASCII, also just before a name
        forms = "|".join(map(re.escape, (text, json.dumps(text)[1:-1])))
        if re.search(
            rf"(?:(?<!\w)|(?<=\\[bfnrt])|(?<=\\u[0-9a-f]{{4}}))({forms})(?!\w)".encode(), data
        ):
            return what
    return None


def carry_publication(
    publication: Publication, spec: Spec, layout: Layout, target: Layout, slimming: Slimming
) -> None:
    """Copy what is new. What is there already stays as it is, and nothing is removed.

    Args:
        slimming: what the copies leave out.
    """
    for folder in (target.store, target.tmp, target.reports(spec.name)):
        target.within(folder)
    if not publication.new and not publication.reports:
        return
    target.root.mkdir(parents=True, exist_ok=True)
    with held(
        target.publishing, waiting_aloud(f"another wasp publish writes to '{target.root}'; waiting")
    ):
        # The folder may be left from a publication that was killed: nobody else has the lock, and
        # neither runs nor gc clean up here.
        staged = target.tmp / STAGED
        artifact.discard(staged)
        try:
            staged.mkdir(parents=True)
            for item in publication.new:
                _copy(item, layout, target, staged, slimming)
            if (target.root / FOLDER).is_dir():
                write_pack(target.root, spec.name)
            reports = target.reports(spec.name)
            for path in publication.reports:
                reports.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, staged / path.name, follow_symlinks=False)
                os.replace(staged / path.name, reports / path.name)
        finally:
            artifact.discard(staged)
            with suppress(OSError):  # a run uses the folder too
                target.tmp.rmdir()
            target.publishing.unlink(missing_ok=True)


def _copy(item: Item, layout: Layout, target: Layout, staged: Path, slimming: Slimming) -> None:
    kind = item.node.kind
    key = item.node.key
    if artifact.corruption(target, kind, key) is None:  # it was published meanwhile
        return
    if artifact.damage(target, kind, key) is None:  # it has the right sizes, but other bytes
        artifact.invalidate(target, kind, key, "it had other bytes than were published")
    staging = staged / key
    staging.mkdir()
    copy_files(layout, kind, key, item.manifest, staging)
    manifest = dict(item.manifest)
    left_out = {**item.manifest.get(SLIM, {}), **slim(staging, kind, slimming)}
    if left_out:
        manifest[SLIM] = left_out
    artifact.commit(target, kind, key, staging, manifest)


def fewer_steps(publication: Publication, target: Layout, steps: int | None) -> int:
    """Count the cells that are published with the steps of fewer episodes than are asked for,
    although this results folder has more.
    """
    most = math.inf if steps is None else steps
    count = 0
    for item in publication.there:
        published = artifact.read_manifest(target, item.node.kind, item.node.key)
        if steps_kept(published) < min(steps_kept(item.manifest), most):
            count += 1
    return count


def show_publication(publication: Publication, largest: float) -> None:
    """Print what is published by kind, and what is left out and why."""
    # The sizes are those here: copies without steps or images are smaller.
    table = count_table("kind", "new", "size here", "there already")
    for kind in dict.fromkeys(item.node.kind for item in (*publication.new, *publication.there)):
        sizes = [item.size for item in publication.new if item.node.kind == kind]
        there = sum(item.node.kind == kind for item in publication.there)
        table.add_row(Text(kind), str(len(sizes)), size(sum(sizes)), str(there or "-"))
    reports = [path.stat().st_size for path in publication.reports]
    table.add_row("report", str(len(reports)), size(sum(reports)), "-")
    table.add_section()
    total = sum(item.size for item in publication.new) + sum(reports)
    table.add_row(
        "total",
        str(len(publication.new) + len(reports)),
        size(total),
        str(len(publication.there)),
        style="bold",
    )
    out().print(table)
    if publication.other:
        say(
            "left out: the report is not that of the newest run of this spec (wasp run "
            "SPEC, then publish again)"
        )
    for item in publication.large:
        say(
            f"left out: {item.node.label} has {size(item.size)}, more than "
            f"{size(round(largest))} (--largest)"
        )
    if publication.absent:
        kinds = ", ".join(dict.fromkeys(node.kind for node in publication.absent))
        say(
            f"left out: {len(publication.absent)} nodes that were not computed, since "
            f"nothing needs them: {kinds}"
        )
