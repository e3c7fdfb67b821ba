"""Packs: small artifacts of a published layer that lie in git as few compressed files, each written
once.

published/packs/<name>.tar.xz     <kind>/<key>/... of what was published together
published/packs/.<name>.tar.xz    empty, and not in git: that pack was unpacked
published/store/<kind>/<key>/     where it is unpacked to, and not in git

Rows of 30 episodes are mostly descriptions of columns, the same in each file: together they take a
sixth of the room. A pack is unpacked when a `Layout` of its folder is made; from then on the folder
is like any other.
"""

from __future__ import annotations

import errno
import hashlib
import io
import lzma
import os
import shutil
import tarfile
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

from wasp_cli.errors import ArtifactError, StoreError, described

FOLDER = "packs"
SUFFIX = ".tar.xz"
LARGEST = 1 << 30  # bytes of a pack at most, unpacked
# kinds of artifacts that go into packs: the others have weights, which do not compress
KINDS = ("calibration", "counterfactual", "diagnostics", "evaluate")


def unpack(root: Path) -> None:
    """Unpack the packs of a published folder that were not unpacked yet; artifacts that are there
    already stay. Several processes may do so at once.

    Raises:
        ArtifactError: a pack is damaged.
        StoreError: the folder cannot be written.
    """
    with ThreadPoolExecutor(os.cpu_count()) as threads:  # decompression leaves Python to others
        for _ in threads.map(partial(_unpack, root), _waiting(root)):
            pass


def _unpack(root: Path, pack: Path) -> None:
    try:
        with tempfile.TemporaryDirectory(dir=root / FOLDER, prefix=".unpacking-") as folder:
            _extract(pack, Path(folder))
            for unpacked in sorted(Path(folder).glob("*/*")):
                place = root / "store" / unpacked.relative_to(folder)
                if place.parent.is_symlink() or place.parents[1].is_symlink():
                    raise ValueError(f"'{place.parent}' leads elsewhere by a link")
                place.parent.mkdir(parents=True, exist_ok=True)
                try:
                    unpacked.rename(place)
                except OSError:
                    # else it is there already, or another process was faster
                    if not place.is_dir():
                        raise
        _stamp(pack).touch()
    except (tarfile.TarError, lzma.LZMAError, EOFError, ValueError) as error:
        raise ArtifactError(
            f"'{pack}' is damaged: {described(error)}", "restore it, or remove it"
        ) from error
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise StoreError(
            f"cannot unpack '{pack}': {reason}", "copy its folder to where you can write"
        ) from error


def _waiting(root: Path) -> list[Path]:
    """The packs that were not unpacked yet."""
    return [pack for pack in _packs(root) if not _stamp(pack).exists()]


def _packs(root: Path) -> list[Path]:
    with suppress(OSError, ValueError):  # no folder, or no name of one: who reads it says so
        names = sorted(
            name
            for name in os.listdir(root / FOLDER)
            if name.endswith(SUFFIX) and not name.startswith(".")
        )
        return [root / FOLDER / name for name in names]
    return []


def _stamp(pack: Path) -> Path:
    """The empty file that is there when a pack was unpacked."""
    return pack.with_name(f".{pack.name}")


def _extract(pack: Path, folder: Path) -> None:
    """Write the files of a pack below a folder; ValueError where one is no file of an artifact."""
    with _archive(pack) as archive:
        for member in archive:
            parts = member.name.split("/")
            file = archive.extractfile(member) if member.isfile() else None
            leads_out = not {"", ".", ".."}.isdisjoint(parts)
            if file is None or len(parts) < 3 or parts[0] not in KINDS or leads_out:
                raise ValueError(f"'{member.name}' is no file of an artifact")
            path = folder.joinpath(*parts)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(file.read())


def has_to_be_copied(root: Path) -> bool:
    """Return whether a published folder has packs to unpack, and cannot be written."""
    return bool(_waiting(root)) and not _can_be_written(root)


def _can_be_written(root: Path) -> bool:
    return os.access(root / FOLDER, os.W_OK) and os.access(root / "store", os.W_OK)


def usable_copy(root: Path, cache: Path) -> Path | None:
    """Return the copy of a published folder in `cache`; None where it is not there, or has packs
    to unpack and cannot be written.
    """
    copy = _copy_in(cache, root)
    return copy if copy.is_dir() and not has_to_be_copied(copy) else None


def copied(root: Path, cache: Path) -> Path:
    """Return the copy of a published folder in `cache`. Where there is none, it is made and
    unpacked; it gets its name when it is whole.

    Raises:
        OSError: it cannot be written.
        StoreError: the same, while packs are unpacked.
        ArtifactError: a pack is damaged.
    """
    copy = usable_copy(root, cache)
    if copy is not None:
        return copy
    copy = _copy_in(cache, root)
    if copy.is_dir():
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(copy))
    with tempfile.TemporaryDirectory(dir=cache) as folder:
        made = Path(folder, "copy")
        _copy(root, made)
        unpack(made)
        with suppress(OSError):  # another process was faster
            made.rename(copy)
    return copy


def _copy_in(cache: Path, root: Path) -> Path:
    """Where the copy of a published folder is: named by the packs that it has to unpack."""
    names = "".join(pack.name for pack in _waiting(root))
    return cache / hashlib.sha256(names.encode()).hexdigest()[:12]


def _copy(root: Path, target: Path) -> None:
    """Copy the files of a folder, without the modes of a package that is read only."""
    for folder, _, names in os.walk(root, onerror=_raised, followlinks=True):
        place = target / Path(folder).relative_to(root)
        place.mkdir(parents=True)
        for name in names:
            shutil.copyfile(Path(folder, name), place / name)


def _raised(error: OSError) -> None:
    raise error


def write_pack(root: Path, name: str) -> Path | None:
    """Write what lies in the store of a published folder and in none of its packs to a new pack;
    None where there is nothing.

    Its name ends with a digest of its bytes, so that no other pack ever has it.
    """
    store = root / "store"
    # Artifacts that are in a pack already, and files of the others.
    packed: set[Path] = set()
    for pack in _packs(root):
        for member in _names(pack):
            packed.add(store.joinpath(*member.split("/")[:2]))  # kind and key
    files: list[Path] = []
    for kind in KINDS:
        for artifact in store.glob(f"{kind}/*"):
            if artifact not in packed:
                files += [path for path in artifact.rglob("*") if _is_plain(path)]
    if not files:
        return None
    # Files of one name lie side by side: they have most bytes in common.
    members: dict[str, bytes] = {}
    for path in sorted(files, key=_by_name):
        members[path.relative_to(store).as_posix()] = path.read_bytes()
    data = lzma.compress(tar_of(members), preset=9 | lzma.PRESET_EXTREME)
    pack = root / FOLDER / f"{name}-{hashlib.sha256(data).hexdigest()[:12]}{SUFFIX}"
    partial = pack.with_name(f"{_stamp(pack).name}-partial")
    partial.write_bytes(data)
    _stamp(pack).touch()
    return partial.rename(pack)


def _is_plain(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def _by_name(path: Path) -> tuple[str, Path]:
    return path.name, path


def _names(pack: Path) -> list[str]:
    """The names of the files in a pack."""
    with _archive(pack) as archive:
        return archive.getnames()


def _archive(pack: Path) -> tarfile.TarFile:
    """A pack, open for reading; EOFError where it is cut off, or unpacks to too much."""
    reader = lzma.LZMADecompressor()
    data = reader.decompress(pack.read_bytes(), LARGEST)
    # The checksum is at the end, so that what has no end is damaged. `LARGEST` guards against a few
    # bytes that unpack to more than the memory holds.
    if not reader.eof:
        raise EOFError(f"it was cut off, or has more than {LARGEST >> 20} MB")
    return tarfile.open(fileobj=io.BytesIO(data))


def tar_of(members: Mapping[str, bytes]) -> bytes:
    """Return an archive of files by name; the same files give the same bytes."""
    raw = io.BytesIO()
    with tarfile.open(fileobj=raw, mode="w") as archive:
        for member, data in members.items():
            entry = tarfile.TarInfo(member)
            entry.size = len(data)
            entry.mode = 0o644
            archive.addfile(entry, io.BytesIO(data))
    return raw.getvalue()
