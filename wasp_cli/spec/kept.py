"""Values that were computed from files before, kept in the cache folder under the content of these
files: so they may be missing, but never wrong.

    <cache>/kept/<name>-<version>.json      a checksum, and below it the values as JSON
    <cache>/kept/<name>-<version>.bin       a checksum, and below it bytes

Nothing depends on them. If a file is missing, cut off, changed or of another version, or a folder
cannot be read or written, it is as if nothing had been kept. Several processes may write at once:
each replaces the whole file, and the last one remains.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from wasp_cli.spec.cache import folders, make, own_folders
from wasp_cli.store.plain import LARGEST, open_plain

FOLDER = "kept"
UNUSED_DAYS = 90  # after which a file that nobody has written is removed


def read_kept(name: str, version: str) -> dict[str, Any]:
    """Return the values that are kept under a name; empty if there are none of this version."""
    for content in _contents(f"{name}-{version}.json"):
        with suppress(ValueError, RecursionError):
            values = json.loads(content)
            if isinstance(values, dict):
                return values
    return {}


def keep(name: str, version: str, values: Mapping[str, Any]) -> None:
    """Replace the values that are kept under a name. Nothing happens if no cache folder can be
    written.
    """
    _write(f"{name}-{version}.json", json.dumps(values, separators=(",", ":")).encode())


def read_kept_bytes(name: str, version: str) -> bytes | None:
    """Return the bytes that are kept under a name; None if there are none of this version."""
    return next(_contents(f"{name}-{version}.bin"), None)


def keep_bytes(name: str, version: str, content: bytes) -> None:
    """Replace the bytes that are kept under a name. Nothing happens if no cache folder can be
    written.
    """
    _write(f"{name}-{version}.bin", content)


def forget(name: str, version: str) -> None:
    """Remove the values that are kept under a name."""
    for folder in own_folders():
        with suppress(OSError):
            (folder / FOLDER / f"{name}-{version}.json").unlink()


@cache
def code_version(*modules: ModuleType) -> str:
    """Return a digest of the source of modules, as the version of what they compute."""
    digest = hashlib.sha256()
    for module in modules:
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()[:12]


def _contents(file_name: str) -> Iterator[bytes]:
    """What is below the checksum in the files of this name, where the checksum is right."""
    for folder in own_folders():
        with suppress(OSError):
            checksum, _, content = _read(folder / FOLDER / file_name).partition(b"\n")
            if checksum == _checksum(content):
                yield content


def _read(path: Path) -> bytes:
    with open_plain(path) as file:
        if os.fstat(file.fileno()).st_size > LARGEST:
            return b""
        return file.read()


def _write(file_name: str, content: bytes) -> None:
    for folder in folders():
        with suppress(OSError):
            make(folder)
            path = folder / FOLDER / file_name
            path.parent.mkdir(exist_ok=True)
            _remove_unused(path.parent)
            partial = path.with_suffix(f".{uuid.uuid4().hex[:8]}")
            try:
                partial.write_bytes(_checksum(content) + b"\n" + content)
                os.replace(partial, path)
            finally:
                partial.unlink(missing_ok=True)
            return


def _checksum(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


def _remove_unused(folder: Path) -> None:
    """Remove files of former versions, of folders that are gone, and of killed processes."""
    oldest = time.time() - UNUSED_DAYS * 24 * 3600
    for path in folder.iterdir():
        with suppress(OSError):
            if path.stat().st_mtime < oldest:
                path.unlink()
