"""The cache folder: what was computed before (`spec.kept`), and the published results where they
lie in a package that nobody may write to.

$XDG_CACHE_HOME/wasp    where the variable names a folder from the root
~/.cache/wasp           else, where the account has a home
/tmp/wasp-<user id>     where none of these can be written; it is the user's alone
"""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from wasp_cli.errors import StoreError, refusal
from wasp_cli.store.packs import copied, has_to_be_copied, usable_copy

NAME = "wasp"
REMEDY = (
    "set XDG_CACHE_HOME to a folder that can be written, with 160 MB of space; "
    "--reuse none does without published results"
)


def unpackable(root: Path) -> Path:
    """Return a published folder whose packs can be unpacked: itself, or a copy in the cache folder
    where nobody may write to it.

    Raises StoreError where a copy is needed, and no cache folder can be written.
    """
    if not has_to_be_copied(root):
        return root
    refused: list[str] = []
    for folder in folders():
        try:
            make(folder)
            return copied(root, folder)
        except OSError as error:
            refused.append(refusal(error).message)
        except StoreError as error:
            refused.append(error.message)
    raise StoreError(_refused_text(refused), REMEDY)


def place(root: Path) -> Path | None:
    """Return the folder that `unpackable` would use for a copy, and None where it needs no copy.
    Nothing is created.

    Raises StoreError where it could not write to any.
    """
    if not has_to_be_copied(root):
        return None
    refused: list[str] = []
    for folder in folders():
        try:
            if folder == temporary_folder() and os.path.lexists(folder):
                _require_own(folder)
            if usable_copy(root, folder) is None:
                _require_writable(folder)
            return folder
        except OSError as error:
            refused.append(refusal(error).message)
    raise StoreError(_refused_text(refused), REMEDY)


def _refused_text(refused: list[str]) -> str:
    reasons = "; ".join(refused) or "this account has no home folder"
    return f"the published results cannot be unpacked: {reasons}"


def folders() -> Iterator[Path]:
    """Yield the folders that may be the cache, the best one first."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if named.is_absolute():  # others are to be ignored, says the XDG base directory specification
        yield named / NAME
    else:
        # stays "~" for an account that has neither HOME nor an entry among the users
        home = Path(os.path.expanduser("~"))
        if home.is_absolute():
            yield home / ".cache" / NAME
    if (temporary := temporary_folder()) is not None:
        yield temporary


def own_folders() -> Iterator[Path]:
    """Yield those that are there, the best one first; one below the folder for temporary files
    only where others cannot write to it.
    """
    for folder in folders():
        with suppress(OSError):
            if folder == temporary_folder():
                _require_own(folder)
            if folder.is_dir():
                yield folder


def temporary_folder() -> Path | None:
    """Return the user's own cache below the folder for temporary files; None where there is no
    such folder.
    """
    with suppress(FileNotFoundError):
        return Path(tempfile.gettempdir(), f"{NAME}-{os.geteuid()}")
    return None


def make(folder: Path) -> None:
    """Create a cache folder. Raises OSError where that is refused, or where others could write to
    one below the folder for temporary files.
    """
    if folder != temporary_folder():
        folder.mkdir(parents=True, exist_ok=True)
        return
    with suppress(FileExistsError):
        folder.mkdir(mode=stat.S_IRWXU)
        folder.chmod(stat.S_IRWXU)  # whatever the umask takes away
    _require_own(folder)


def _require_own(folder: Path) -> None:
    """See that a folder which everybody could have made is the user's, and nobody else's."""
    found = folder.lstat()
    alone = found.st_uid == os.geteuid() and not found.st_mode & (stat.S_IRWXG | stat.S_IRWXO)
    if not stat.S_ISDIR(found.st_mode) or not alone:
        raise PermissionError(errno.EPERM, "it is not this user's alone", str(folder))


def _require_writable(folder: Path) -> None:
    there = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
    if not os.path.isdir(there):
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(there))
    if not os.access(there, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(there))
