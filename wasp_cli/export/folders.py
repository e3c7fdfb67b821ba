"""Where a dataset is written: beside its place, and moved there when it is whole."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from wasp_cli.errors import UsageError


def require_place(target: Path, mark: str, *, force: bool) -> None:
    """See that a dataset can be written to a folder, before anything is read or played.

    Args:
        target: the folder.
        mark: a file that a dataset of this format has, relative to its folder.
        force: whether a dataset of this format that is there may be replaced.

    Raises:
        UsageError: the folder holds something else, or a dataset that may not be replaced.
    """
    if not os.path.lexists(target):
        return
    if target.is_symlink() or not target.is_dir():
        raise UsageError(f"'{target}' is not a folder", "name a new folder")
    if not any(target.iterdir()):
        return
    if not (target / mark).is_file():
        raise UsageError(
            f"'{target}' holds other files than a dataset of this format",
            "name a new folder: --force replaces a dataset, and nothing else",
        )
    if not force:
        raise UsageError(
            f"'{target}' is there already", "--force replaces it; or name another folder"
        )


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Give a new folder beside `target`, which takes its place when the block ends.

    A dataset that is there stays until the new one is whole, and stays where the block raises.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    token = uuid.uuid4().hex[:8]
    staged = target.with_name(f".{target.name}-{token}")
    before = target.with_name(f".{target.name}-{token}-before")
    staged.mkdir()
    try:
        yield staged
        if target.exists():
            os.replace(target, before)
        try:
            os.replace(staged, target)
        except OSError:
            if before.exists():
                os.replace(before, target)
            raise
    finally:
        shutil.rmtree(staged, ignore_errors=True)
    shutil.rmtree(before, ignore_errors=True)


def size_of(folder: Path) -> int:
    """Return the bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
