"""A published folder as one file for an archive: rows, trained parts, reports, checksums, the licence, and a card in the hub's format.

The same folder gives the same bytes.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import tarfile
from collections.abc import Iterator
from importlib.metadata import distribution
from pathlib import Path

import wasp_cli
from wasp_cli.errors import ArtifactError, StoreError, UsageError
from wasp_cli.store.artifact import read_manifest, stored_keys, stored_kinds
from wasp_cli.store.layout import Layout

CARD = """\
---
license: apache-2.0
library_name: wasp-cli
pipeline_tag: reinforcement-learning
tags: [shared-autonomy, safe-reinforcement-learning, world-model, mujoco]
---

# {name}

Results and trained models of `{name}`, an experiment in safety-aware shared autonomy, written by wasp {version}.

| Kind | Artifacts | Tasks |
| --- | ---: | --- |
{rows}

Unpack it, and name the folder to compute further cells with these models, or to compute some again and compare them to the bit:

    wasp run {name} --reuse DIR
    wasp verify DIR --cells 30

`sha256sum --check SHA256SUMS` compares every file. The manifest of an artifact has its settings, inputs, library versions and commit.
"""


def write_archive(target: Layout, name: str, file: Path) -> int:
    """Write a `.tar.gz` of a published folder; returns the number of files in it."""
    if not file.name.endswith(".tar.gz"):
        raise UsageError(f"'{file}' is no name of an archive", f"it ends with .tar.gz: {file.name.partition('.')[0]}.tar.gz")
    if file.exists():
        raise UsageError(f"'{file}' is there already", "remove it, or name another file")
    if not target.store.is_dir():
        raise StoreError(f"nothing is published in '{target.root}'")
    folders = [folder for folder in (target.store, target.root / "reports") if folder.is_dir()]
    paths = sorted(path for folder in folders for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    members = {path.relative_to(target.root).as_posix(): path.read_bytes() for path in paths}
    members |= {"README.md": _card(target, name).encode(), "LICENSE": _licence()}
    sums = "".join(f"{hashlib.sha256(data).hexdigest()}  {member}\n" for member, data in sorted(members.items()))
    members["SHA256SUMS"] = sums.encode()
    root = file.name.removesuffix(".tar.gz")
    with file.open("xb") as raw, gzip.GzipFile("", "wb", fileobj=raw, mtime=0) as packed, tarfile.open(fileobj=packed, mode="w") as archive:
        for member, data in sorted(members.items()):
            entry = tarfile.TarInfo(f"{root}/{member}")
            entry.size, entry.mode = len(data), 0o644
            archive.addfile(entry, io.BytesIO(data))
    return len(members)


def _card(target: Layout, name: str) -> str:
    return CARD.format(name=name, version=wasp_cli.__version__, rows="\n".join(_rows(target)))


def _rows(target: Layout) -> Iterator[str]:
    for kind in sorted(stored_kinds(target)):
        keys, tasks = stored_keys(target, kind), set()
        for key in keys:
            try:
                tasks.add(str(read_manifest(target, kind, key)["task"]))
            except (ArtifactError, KeyError):
                tasks.add("damaged")
        yield f"| {kind} | {len(keys)} | {', '.join(sorted(tasks))} |"


def _licence() -> bytes:
    """The text of the licence: that of the checkout, or the installed package's."""
    beside = Path(__file__).parents[2] / "LICENSE"
    if beside.is_file():
        return beside.read_bytes()
    return next(Path(str(path.locate())).read_bytes() for path in distribution("wasp-cli").files or () if path.name == "LICENSE")
