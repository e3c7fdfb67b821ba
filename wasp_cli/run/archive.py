"""A published folder as one archive, with checksums, licence and a card. The same folder gives the
same bytes.
"""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Iterator
from importlib.metadata import distribution
from importlib.resources import files
from pathlib import Path

from jinja2 import Template

import wasp_cli
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.run.verify import EVALUATE, why_not
from wasp_cli.store import artifact, records
from wasp_cli.store.layout import Layout
from wasp_cli.store.packs import tar_of


def require_archive(file: Path) -> None:
    """See that an archive can have this name, which is that of the folder in it.

    Raises:
        UsageError: it cannot, or there is a file of this name already.
    """
    stem = file.name.removesuffix(".tar.gz")
    if not file.name.endswith(".tar.gz") or not artifact.is_file_name(stem):
        raise UsageError(
            f"'{file}' is no name of an archive",
            f"it ends with .tar.gz: {file.name.partition('.')[0] or 'mine'}.tar.gz",
        )
    if not file.parent.is_dir():
        raise UsageError(f"'{file.parent}' is no folder", "make it, or name another file")
    if file.exists():
        raise UsageError(f"'{file}' is there already", "remove it, or name another file")


def write_archive(target: Layout, name: str, file: Path) -> int:
    """Write a `.tar.gz` of a published folder; return the number of files in it.

    Raises:
        StoreError: nothing is published there.
    """
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
    members |= {"README.md": card.encode(), "LICENSE": _licence().read_bytes()}
    sums = "".join(
        f"{hashlib.sha256(data).hexdigest()}  {member}\n"
        for member, data in sorted(members.items())
    )
    members["SHA256SUMS"] = sums.encode()
    folder = file.name.removesuffix(".tar.gz")
    archive = tar_of({f"{folder}/{member}": data for member, data in sorted(members.items())})
    records.replace_file(file, gzip.compress(archive, mtime=0))
    return len(members)


def _licence() -> Path:
    """The licence beside the source, or in the installed package."""
    root = Path(__file__).parents[2]
    if (root / "pyproject.toml").is_file():
        return root / "LICENSE"
    installed = distribution("wasp-cli").files or ()
    return Path(str(next(each.locate() for each in installed if each.name == "LICENSE")))


def _rows(target: Layout) -> Iterator[tuple[str, int, str]]:
    for kind in sorted(artifact.stored_kinds(target)):
        keys = artifact.stored_keys(target, kind)
        tasks = {str(artifact.read_manifest(target, kind, key).get("task")) for key in keys}
        yield kind, len(keys), ", ".join(sorted(tasks))
