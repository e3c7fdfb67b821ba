"""The cache folder: values that were computed before (`spec.kept`), and copies of published results
that lie in a package which the user may not write to.

$XDG_CACHE_HOME/wasp    if the variable has an absolute path
~/.cache/wasp           otherwise, if the account has a home
/tmp/wasp-<user id>     if none of these can be written; only the user can read and write it
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
    if this user may not write to it.

    Raises:
        StoreError: a copy is needed, and no cache folder can be written.
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
    """Return the folder in which `unpackable` would make a copy; None if it needs none. Nothing is
    created.

    Raises:
        StoreError: a copy is needed, and no cache folder can be written.
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
    if named.is_absolute():  # the XDG base directory specification ignores other paths
        yield named / NAME
    else:
        # remains "~" for an account that has neither HOME nor an entry in the list of users
        home = Path(os.path.expanduser("~"))
        if home.is_absolute():
            yield home / ".cache" / NAME
    temporary = temporary_folder()
    if temporary is not None:
        yield temporary


def own_folders() -> Iterator[Path]:
    """Yield the cache folders that exist, the best one first. The one below the folder for
    temporary files counts only if others cannot write to it.
    """
    for folder in folders():
        with suppress(OSError):
            if folder == temporary_folder():
                _require_own(folder)
            if folder.is_dir():
                yield folder


def temporary_folder() -> Path | None:
    """Return the user's own cache below the folder for temporary files; None if there is no such
    folder.
    """
    with suppress(FileNotFoundError):
        return Path(tempfile.gettempdir(), f"{NAME}-{os.geteuid()}")
    return None


def make(folder: Path) -> None:
    """Create a cache folder. Raises OSError if that is not allowed, or if others could write to the
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
    """Raise PermissionError if others could have made a folder, or can read or write it."""
    status = folder.lstat()
    is_own = status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IRWXG | stat.S_IRWXO)
    if not stat.S_ISDIR(status.st_mode) or not is_own:
        raise PermissionError(errno.EPERM, "it is not only this user's", str(folder))


def _require_writable(folder: Path) -> None:
    """Raise OSError if a folder, or the nearest folder above it that exists, cannot be written."""
    existing = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
    if not os.path.isdir(existing):
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(existing))
    if not os.access(existing, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(existing))
