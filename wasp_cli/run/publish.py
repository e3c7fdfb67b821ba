"""`wasp publish`: from a results folder to the published layer, which lies in git and that anyone
may read; and from there to an archive.

What is copied is whole, small, and says where it came from without naming a person's machine. The
same layer gives an archive of the same bytes.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import math
import os
import platform
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import distribution
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Template
from rich.text import Text

import wasp_cli
from wasp_cli.cells.runs import planned_run, run_ids
from wasp_cli.console import count_table, out, say, size, waiting_aloud
from wasp_cli.errors import ArtifactError, StoreError, UsageError, first
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.plan.grid import Grid, select
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import plan_against
from wasp_cli.plan.reuse import lay_out_over, recipes_in
from wasp_cli.run.verify import EVALUATE, why_not
from wasp_cli.spec.model import Spec
from wasp_cli.stages.registry import STAGES
from wasp_cli.store import artifact, records
from wasp_cli.store.layout import Layout, is_name
from wasp_cli.store.lock import held
from wasp_cli.store.packs import FOLDER, tar_of, write_pack
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
"""What a published manifest keeps of its provenance. Left out are the host, the command, the
run and the log.
"""
SHORTEST = 4  # characters of a private name at least: a shorter one is found everywhere by chance
STAGED = "publish"  # where in `tmp/` copies are made
NAMED = 12  # nodes that a refusal names


@dataclass(frozen=True)
class Item:
    node: Node
    source: Layout  # where it lies
    size: int
    manifest: Mapping[str, Any]  # as it will be published


@dataclass(frozen=True)
class Publication:
    new: tuple[Item, ...]
    there: tuple[Item, ...]  # those that the published layer has already, byte for byte
    large: tuple[Item, ...]
    absent: tuple[Node, ...]  # what was not computed because nothing needs it
    reports: tuple[Path, ...]
    # whether the report that is here is of another run than what is published, and left out
    other: bool


def publication(
    spec: Spec, layout: Layout, target: Layout, selectors: Sequence[str], largest: float, reuse: str
) -> Publication:
    """Return what of a spec can be published: artifacts of at most `largest` bytes, chosen by
    `--select`; nothing is written.

    With the `reuse` of `none` results of this code alone. An ArtifactError where something is not
    computed, damaged, or names this machine.
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
    refused = [f"{step.node.label}: {step.reason}" for step in steps if step.runs]
    reused = [step.node for step in steps if step.state == "published"]
    elsewhere = [
        node for node in reused if artifact.damage(target, node.kind, node.key) is not None
    ]
    refused += [
        f"{node.label}: it was published elsewhere, and is not in '{layout.root}'"
        for node in elsewhere
    ]
    sources = [
        (step.node, layout if step.state == "cached" else target)
        for step in steps
        if step.state in ("cached", "published")
    ]
    behind = _behind(grid)
    items = [
        _item(node, source, behind[node.key]) for node, source in sources if node not in elsewhere
    ]
    small = [item for item in items if item.size <= largest]
    there = [
        item for item in small if artifact.corruption(target, item.node.kind, item.node.key) is None
    ]
    new = [item for item in small if item not in there]
    old = {
        path.name: path.read_bytes()
        for path in target.reports(spec.name).glob("*")
        if path.is_file()
    }
    folder = layout.within(layout.reports(spec.name))
    written = [
        path
        for path in sorted(folder.glob("*"))
        if is_name(path.name) and path.is_file() and not path.is_symlink()
    ]
    last = next(
        (
            run
            for run_id in run_ids(layout)
            if (run := planned_run(layout, run_id)) is not None and run.spec == spec.name
        ),
        None,
    )
    # Until the newest run has written its report, what lies there is that of an earlier one.
    of_last = (
        last is not None
        and last.nodes.keys() == {node.key for node in grid.nodes}
        and not layout.reporting(last.run_id).exists()
    )
    other = bool(written) and not of_last
    reports = [path for path in written if not other and old.get(path.name) != path.read_bytes()]
    private = _private(layout)
    refused += [f"{item.node.label}: {why}" for item in new if (why := _why_not(item, private))]
    refused += [
        f"'{path}': it names {named}"
        for path in reports
        if (named := _named(path.read_bytes(), private))
    ]
    if refused:
        lines = [
            f"{len(refused)} results cannot be published:",
            *first([f"  {text}" for text in refused], NAMED),
        ]
        lacking = not all(": it names " in text for text in refused)
        raise ArtifactError(
            "\n".join(lines),
            "wasp run SPEC --reuse none computes what is missing, with this code"
            if lacking
            else None,
        )
    large = tuple(item for item in items if item.size > largest)
    absent = tuple(step.node for step in steps if step.state == "unneeded")
    return Publication(tuple(new), tuple(there), large, absent, tuple(reports), other)


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
    kind, key = item.node.kind, item.node.key
    if (wrong := artifact.corruption(item.source, kind, key)) is not None:
        return wrong
    folder = item.source.artifact(kind, key)
    texts = [
        records.dumps(item.manifest).encode(),
        *((folder / name).read_bytes() for name in item.manifest["files"]),
    ]
    named = next(filter(None, (_named(text, private) for text in texts)), None)
    return None if named is None else f"it names {named}"


def _private(layout: Layout) -> dict[str, str]:
    """What must not be published, by what it is: where things lie on this machine, and its name."""
    checkout = Path(wasp_cli.__file__).resolve().parents[1]
    named = {
        "the results folder": str(layout.root),
        "the results folder behind a link": str(layout.root.resolve()),
        "the folder of the source": str(checkout),
        # of an account without one "~", which is too short to be looked for
        "the home folder": os.path.expanduser("~"),
        "this machine": platform.node(),
    }
    # a machine of such a name is not told by it
    words = {"localhost", "wasp", *METHODS, *OPERATORS, *TASKS, *STAGES}
    return {
        what: text for what, text in named.items() if len(text) >= SHORTEST and text not in words
    }


def _named(data: bytes, private: Mapping[str, str]) -> str | None:
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
    """Copy what is new; what is there already stays as it is, and nothing is removed.
    `slimming` says what the copies leave out.
    """
    for folder in (target.store, target.tmp, target.reports(spec.name)):
        target.within(folder)
    if not publication.new and not publication.reports:
        return
    target.root.mkdir(parents=True, exist_ok=True)
    with held(
        target.publishing, waiting_aloud(f"another wasp publish writes to '{target.root}'; waiting")
    ):
        # What lies there was left by one that was killed: nobody else has the lock. No sweep of a
        # run or of gc touches this folder.
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
    kind, key = item.node.kind, item.node.key
    if artifact.corruption(target, kind, key) is None:  # another one has published it since
        return
    if artifact.damage(target, kind, key) is None:  # of the right sizes, and with other bytes
        artifact.invalidate(target, kind, key, "it had other bytes than were published")
    staging = staged / key
    staging.mkdir()
    copy_files(layout, kind, key, item.manifest, staging)
    left_out = {**item.manifest.get(SLIM, {}), **slim(staging, kind, slimming)}
    artifact.commit(
        target, kind, key, staging, {**item.manifest, **({SLIM: left_out} if left_out else {})}
    )


def fewer_steps(publication: Publication, target: Layout, steps: int | None) -> int:
    """Count the cells that were published with the steps of fewer episodes than are asked for,
    and are here.
    """
    pairs = [
        (item.manifest, artifact.read_manifest(target, item.node.kind, item.node.key))
        for item in publication.there
    ]
    return sum(
        steps_kept(there) < min(steps_kept(here), math.inf if steps is None else steps)
        for here, there in pairs
    )


def show_publication(publication: Publication, largest: float) -> None:
    # copies without steps or images are smaller
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


def require_archive(file: Path) -> None:
    """See that an archive can have this name, which is that of the folder in it. Raises
    UsageError.
    """
    if not file.name.endswith(".tar.gz") or not artifact.is_file_name(
        file.name.removesuffix(".tar.gz")
    ):
        raise UsageError(
            f"'{file}' is no name of an archive",
            f"it ends with .tar.gz: {file.name.partition('.')[0] or 'mine'}.tar.gz",
        )
    if not file.parent.is_dir():
        raise UsageError(f"'{file.parent}' is no folder", "make it, or name another file")
    if file.exists():
        raise UsageError(f"'{file}' is there already", "remove it, or name another file")


def write_archive(target: Layout, name: str, file: Path) -> int:
    """Write a `.tar.gz` of a published folder; returns the number of files in it."""
    if not target.store.is_dir():
        raise StoreError(f"nothing is published in '{target.root}'")
    folders = [folder for folder in (target.store, target.root / "reports") if folder.is_dir()]
    paths = sorted(
        path
        for folder in folders
        for path in folder.rglob("*")
        if path.is_file() and not path.is_symlink()
    )
    members = {path.relative_to(target.root).as_posix(): path.read_bytes() for path in paths}
    again = any(
        why_not(target, key) is None for key in sorted(artifact.stored_keys(target, EVALUATE))
    )
    template = Template(
        files("wasp_cli.run").joinpath("card.md").read_text(encoding="utf-8"),
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    card = template.render(name=name, version=wasp_cli.__version__, rows=_rows(target), again=again)
    root = Path(__file__).parents[2]
    checkout = (root / "pyproject.toml").is_file()  # else the installed package has it
    path = (
        root / "LICENSE"
        if checkout
        else next(
            file.locate() for file in distribution("wasp-cli").files or () if file.name == "LICENSE"
        )
    )
    members |= {"README.md": card.encode(), "LICENSE": Path(str(path)).read_bytes()}
    sums = "".join(
        f"{hashlib.sha256(data).hexdigest()}  {member}\n"
        for member, data in sorted(members.items())
    )
    members["SHA256SUMS"] = sums.encode()
    folder = file.name.removesuffix(".tar.gz")
    archive = tar_of({f"{folder}/{member}": data for member, data in sorted(members.items())})
    records.replace_file(file, gzip.compress(archive, mtime=0))
    return len(members)


def _rows(target: Layout) -> Iterator[tuple[str, int, str]]:
    for kind in sorted(artifact.stored_kinds(target)):
        keys = artifact.stored_keys(target, kind)
        tasks = {str(artifact.read_manifest(target, kind, key).get("task")) for key in keys}
        yield kind, len(keys), ", ".join(sorted(tasks))
