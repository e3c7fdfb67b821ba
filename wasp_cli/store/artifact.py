"""Artifacts: folders that are written beside their place, then moved there in one step."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.store.layout import MANIFEST, Layout, is_key, is_name
from wasp_cli.store.lock import is_held
from wasp_cli.store.plain import printable, read_plain
from wasp_cli.store.records import dumps, read_record

Stamp = tuple[int, int, int, int]
"""Inode, size, and the times of the last write and of the last change, in ns: nobody sets the last
one.
"""

LONGEST_NAME = 1024  # characters of a file's name in a manifest at most


def staging_folder(layout: Layout, key: str) -> Path:
    """Return a new empty folder in `tmp/`, for one attempt at one artifact."""
    folder = layout.tmp / f"{key}-{uuid.uuid4().hex[:12]}"
    folder.mkdir(parents=True)
    return folder


def commit(
    layout: Layout,
    kind: str,
    key: str,
    staging: Path,
    manifest: Mapping[str, Any],
    copied: bool = False,
) -> Path:
    """Complete an artifact with its manifest, move it to its place, and return that.

    Everything is on disk before the move, and the move is one rename, so that a reader sees the
    whole artifact or none. When the place is taken, someone else has computed the same key: theirs
    stays, unless it is damaged.

    Args:
        layout: of the results folder.
        kind: of the node.
        key: of the node.
        staging: the folder with the artifact's files, from `staging_folder`.
        manifest: without the list of files, which is added.
        copied: whether it is a copy of an artifact that exists. Then nothing waits for the disk:
            after a power failure the copy may be damaged, and is made again.

    Raises:
        ArtifactError: there is a link among the files.
        OSError: a file cannot be written, or the folder cannot be moved.
    """
    (staging / MANIFEST).write_text(dumps({**manifest, "files": _files(staging)}), encoding="utf-8")
    if not copied:
        for path in sorted(staging.rglob("*"), reverse=True):
            _sync(path)
        _sync(staging)
    place = layout.artifact(kind, key)
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.replace(staging, place)
    except OSError:
        if damage(layout, kind, key) is None:
            shutil.rmtree(staging)
            return place
        # What is there is no whole artifact: someone has removed or changed files by hand.
        rubbish = staging.with_name(f"{staging.name}-rubbish")
        with suppress(FileNotFoundError):  # then the next line raises what was in the way
            os.replace(place, rubbish)
        os.replace(staging, place)
        discard(rubbish)
    if not copied:
        _sync(place.parent)
    return place


def artifact_keys(layout: Layout, kind: str) -> list[str]:
    """Return the keys of a kind that have a folder, sorted, whatever is in it. Raises StoreError
    where the folder of the kind cannot be read.
    """
    try:
        with os.scandir(layout.within(layout.kind(kind))) as entries:
            return sorted(
                entry.name
                for entry in entries
                if is_key(entry.name) and entry.is_dir(follow_symlinks=False)
            )
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StoreError(
            f"cannot read '{layout.kind(kind)}': {(error.strerror or str(error)).lower()}"
        ) from error


def stored_keys(layout: Layout, kind: str) -> set[str]:
    """Return the keys of all artifacts of a kind, damaged ones too."""
    return {key for key in artifact_keys(layout, kind) if layout.manifest(kind, key).is_file()}


def stored_kinds(layout: Layout) -> list[str]:
    """Return the kinds of which a store has artifacts, whatever version wrote them."""
    with suppress(OSError), os.scandir(layout.within(layout.store)) as entries:
        return sorted(
            entry.name
            for entry in entries
            if entry.is_dir(follow_symlinks=False) and is_name(entry.name)
        )
    return []


def exists(layout: Layout, kind: str, key: str) -> bool:
    """Return whether an artifact is there, with every file that it was committed with."""
    return damage(layout, kind, key) is None


def damage(layout: Layout, kind: str, key: str) -> str | None:
    """Return what is wrong with an artifact (not there, no readable manifest, a file gone or of
    another size); None when it is whole.

    Sizes only: the manifest has each file's SHA-256 too, but planning must not read gigabytes.
    """
    return read_whole(layout, kind, key)[1]


def read_whole(layout: Layout, kind: str, key: str) -> tuple[dict[str, Any], str | None]:
    """Return the manifest of an artifact, empty where it cannot be read, and what `damage`
    returns.
    """
    try:
        manifest = read_manifest(layout, kind, key)
        sizes = listed_files(manifest, layout.manifest(kind, key))
    except ArtifactError as error:
        return {}, error.message
    return manifest, missing_file(layout, kind, key, sizes)


def listed_files(manifest: Mapping[str, Any], path: Path) -> dict[str, int]:
    """Return the size of each file that an artifact was committed with, by relative name; `path`
    is that of its manifest. Raises ArtifactError where the manifest has no such list.
    """
    try:
        files = {str(name): int(entry["size"]) for name, entry in manifest["files"].items()}
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ArtifactError(f"'{path}' is damaged: it does not list the files") from error
    for name in files:
        if not is_file_name(name):
            raise ArtifactError(f"'{path}' is damaged: '{name}' is not a file of the artifact")
    return files


def missing_file(layout: Layout, kind: str, key: str, sizes: Mapping[str, int]) -> str | None:
    """Return what is wrong with the first file of an artifact that is gone, a link, or of another
    size than in `sizes`; None where all are there.
    """
    place = layout.artifact(kind, key)
    try:
        folder = str(layout.within(place))
        for name, size in sizes.items():
            if "/" in name:
                layout.within(place / name)
            # as texts: a plan asks for thousands
            state = os.lstat(f"{folder}/{name}")
            if stat.S_ISLNK(state.st_mode):
                layout.within(place / name)
            if not stat.S_ISREG(state.st_mode) or state.st_size != size:
                return f"'{place}/{name}' has {state.st_size} bytes, not {size}"
    except StoreError as error:
        return error.message
    except (OSError, ValueError):
        return f"'{place}/{name}' is gone"
    return None


WHY = "_why.txt"  # lies in an artifact that was taken out of use

# stamp and SHA-256 of each file that this process has read, and whose bytes have this SHA-256
_verified: dict[str, tuple[Stamp, str]] = {}


def corruption(layout: Layout, kind: str, key: str) -> str | None:
    """Return what is wrong with the bytes of an artifact, by the SHA-256 of each file; None when
    they are those of the manifest.

    A process reads a file once, as long as it stays the same (`stamp_of`).
    """
    manifest, wrong = read_whole(layout, kind, key)
    return wrong if wrong is not None else changed_file(layout, kind, key, manifest)


def changed_file(layout: Layout, kind: str, key: str, manifest: Mapping[str, Any]) -> str | None:
    """Return what `corruption` does, of an artifact that has the files of this manifest."""
    place = layout.artifact(kind, key)
    for name, entry in manifest["files"].items():
        path = f"{place}/{name}"
        stamp = stamp_of(path)
        digest = entry.get("sha256")
        if stamp is not None and _verified.get(path) == (stamp, digest):
            continue
        if file_digest(place / name) != digest:
            return f"'{path}' has other bytes than were stored"
        if stamp is not None:
            _verified[path] = stamp, digest
    return None


def verified_below(folder: Path) -> dict[str, tuple[Stamp, str]]:
    """Return stamp and SHA-256 of every file below a folder that `corruption` has read."""
    above = f"{folder}/"
    return {path: found for path, found in _verified.items() if path.startswith(above)}


def take_as_verified(files: Mapping[str, tuple[Stamp, str]]) -> None:
    """Let `corruption` know what another process has read, as `verified_below` returned it."""
    for path, found in files.items():
        _verified.setdefault(path, found)


def stamp_of(path: str) -> Stamp | None:
    """Return what tells whether a plain file is still the same; None where there is none."""
    try:
        state = os.lstat(path)
    except OSError:
        return None
    if not stat.S_ISREG(state.st_mode):
        return None
    return state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns


def invalidate(layout: Layout, kind: str, key: str, why: str) -> None:
    """Take an artifact out of use, so that it is computed again; its files stay until then.
    Another process may have done so before.
    """
    manifest = layout.manifest(kind, key)
    with suppress(FileNotFoundError):
        os.replace(manifest, manifest.with_suffix(".invalid"))
    with suppress(OSError):
        (layout.artifact(kind, key) / WHY).write_text(why + "\n", encoding="utf-8")


def why_invalid(layout: Layout, kind: str, key: str) -> str | None:
    """Return why an artifact was taken out of use, in one line; None where it was not."""
    try:
        text = read_plain(layout.artifact(kind, key) / WHY)
    except (OSError, ValueError):
        return None
    return " ".join(printable(text).split())[:500] or None


def is_file_name(name: str) -> bool:
    """Return whether a manifest may list a file of this name: a relative one that does not lead
    out of the artifact.
    """
    if len(name) >= LONGEST_NAME or "\0" in name:
        return False
    return {"", ".", ".."}.isdisjoint(name.split("/"))


def read_manifest(layout: Layout, kind: str, key: str) -> dict[str, Any]:
    """Return the manifest of an artifact. Raises ArtifactError where there is none, or where it
    cannot be read.
    """
    try:
        path = layout.within(layout.manifest(kind, key))
    except StoreError as error:
        raise ArtifactError(error.message, error.hint) from error
    manifest = read_record(path)
    if manifest is None:
        raise ArtifactError(f"no artifact {kind}/{key} in '{layout.root}'")
    return manifest


def sweep(layout: Layout) -> int:
    """Remove what killed processes left in `tmp/`, and return how many folders that were. What a
    living process still writes stays.
    """
    folders = left_behind(layout)
    for folder in folders:
        discard(folder)
    return len(folders)


def left_behind(layout: Layout) -> list[Path]:
    """Return the folders in `tmp/` that no living process writes."""
    folders: list[Path] = []
    for folder in layout.tmp.glob("*-*"):
        key = folder.name.partition("-")[0]
        if is_key(key) and not is_held(layout.lock(key)):
            folders.append(folder)
    return folders


def discard(folder: Path) -> None:
    """Remove a folder, or a file, that nobody needs any more; what is already gone is fine, and
    what a link leads to stays.
    """
    with suppress(FileNotFoundError):
        if folder.is_symlink() or not folder.is_dir():
            folder.unlink()
        else:
            shutil.rmtree(folder)


def _files(folder: Path) -> dict[str, dict[str, Any]]:
    """Size and SHA-256 of every file below a folder, by relative name; its manifest left out."""
    files: dict[str, dict[str, Any]] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            raise ArtifactError(f"'{path}' is a link; artifacts hold plain files only")
        name = path.relative_to(folder).as_posix()
        if path.is_file() and name != MANIFEST:
            files[name] = {"size": path.stat().st_size, "sha256": file_digest(path)}
    return files


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    """Wait until a file or a folder is on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
