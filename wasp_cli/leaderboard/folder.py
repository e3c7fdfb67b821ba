"""The folder of a submission: what it holds, written whole, and read with every byte checked.

halfway/
  submission.json   who, when, of which wasp; hash of the code; the digest of every other file
  rows.parquet      a row for each episode of each cell, as in the cells of a results folder
  spec.yaml         the assistant with its settings; it extends the board
  source/           the assistant's modules and data files, unless its author keeps them
  store/            what was trained for it alone, if anything
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import pyarrow as pa

from wasp_cli.errors import ArtifactError, UsageError, refusal
from wasp_cli.store.artifact import file_digest, is_file_name
from wasp_cli.store.plain import open_plain
from wasp_cli.store.records import read_record, write_record
from wasp_cli.store.tables import CellIdentity, read_episodes

SUBMISSION = "submission.json"
ROWS = "rows.parquet"
SPEC = "spec.yaml"
SOURCE = "source"
STORE = "store"

FORM = 1  # of submission.json; grows with every change that an earlier wasp cannot read


@dataclass(frozen=True)
class Submission:
    """What `submission.json` says."""

    form: int
    name: str
    assistant: str  # as specs name it
    title: str  # as tables name it
    by: str
    when: str  # the day of the last computed cell, as 2026-12-31
    wasp: str  # version that computed it
    commit: str  # of a checkout; empty of an installed package
    board: str  # digest of the board
    code: str  # hash over the digests in `sources`
    sources: Mapping[str, str]  # SHA-256 of the assistant's files, by their names below source/
    modules: Mapping[str, str]  # the hashes of the same as keys have them
    keys: Mapping[str, str]  # by label, the key of every cell
    sample: Sequence[str]  # labels of the cells that `wasp verify` computes again
    seconds: float  # that the cells took
    provenance: Mapping[str, Any]  # processor and versions of libraries
    files: Mapping[str, str]  # SHA-256 of every other file, by name

    @property
    def shown(self) -> str:
        """Who submitted what, for people."""
        return f"{self.title} by {self.by}, {self.when}"


def is_submission(folder: Path) -> bool:
    """Return whether a folder is that of a submission."""
    return (folder / SUBMISSION).is_file()


def code_hash(sources: Mapping[str, str]) -> str:
    """Return the hash over files of source, from the SHA-256 of each by name."""
    lines = [f"{name} {digest}" for name, digest in sorted(sources.items())]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def read_submission(folder: Path) -> Submission:
    """Read a submission; every file of the folder is listed in it and has its digest.

    Raises:
        UsageError: the folder holds no submission.
        ArtifactError: it is damaged or was changed; the message names the file.
    """
    if not is_submission(folder):
        raise UsageError(f"'{folder}' holds no submission", "wasp submit SPEC writes one")
    path = folder / SUBMISSION
    submission = _parsed(read_record(path) or {}, path)
    _check_files(folder, submission)
    if code_hash(submission.sources) != submission.code:
        raise ArtifactError(f"'{path}': the hash of the code is not that of the sources it lists")
    kept = {
        name.removeprefix(f"{SOURCE}/"): digest
        for name, digest in submission.files.items()
        if name.startswith(f"{SOURCE}/")
    }
    if kept and kept != dict(submission.sources):
        raise ArtifactError(
            f"'{folder / SOURCE}' is other code than the one that computed the rows",
            "submit again: wasp submit SPEC --force",
        )
    return submission


def _parsed(record: Mapping[str, Any], path: Path) -> Submission:
    """The submission of a record, after a check of its form."""
    form = record.get("form")
    if isinstance(form, int) and form > FORM:
        raise ArtifactError(f"'{path}' is of a newer wasp (form {form})", "upgrade wasp")
    kinds: dict[str, type | tuple[type, ...]] = {"form": int, "seconds": (int, float)}
    kinds |= dict.fromkeys(("sources", "modules", "keys", "provenance", "files"), dict)
    kinds["sample"] = list
    for field in fields(Submission):
        value = record.get(field.name)
        if not isinstance(value, kinds.get(field.name, str)):
            raise ArtifactError(
                f"'{path}' is damaged: '{field.name}' is missing or has no such form"
            )
    for name in ("sources", "modules", "keys", "files"):
        if not all(isinstance(value, str) for value in record[name].values()):
            raise ArtifactError(f"'{path}' is damaged: '{name}' has something that is no text")
    for name in (*record["sources"], *record["files"]):
        if not is_file_name(name):
            raise ArtifactError(f"'{path}' is damaged: '{name}' is no file of a submission")
    return Submission(**{field.name: record[field.name] for field in fields(Submission)})


def _check_files(folder: Path, submission: Submission) -> None:
    """Raise an ArtifactError unless the folder has the listed files, and no other, byte for
    byte.
    """
    listed = dict(submission.files)
    for name in (ROWS, SPEC):
        if name not in listed:
            raise ArtifactError(f"'{folder / SUBMISSION}' is damaged: it does not list {name}")
    there = {path.relative_to(folder).as_posix() for path in _files(folder)} - {SUBMISSION}
    for name in sorted(there - listed.keys()):
        raise ArtifactError(f"'{folder / name}' is no file of the submission", "remove it")
    for name, digest in sorted(listed.items()):
        path = folder / name
        if name not in there:
            raise ArtifactError(f"'{path}' is missing")
        try:
            with open_plain(path) as file:
                found = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise ArtifactError(refusal(error).message) from error
        if found != digest:
            raise ArtifactError(
                f"'{path}' has other bytes than were submitted",
                "it was changed or damaged: ask for the submission again",
            )


def _files(folder: Path) -> list[Path]:
    """Everything below a folder that is no folder itself, but for what Python compiles."""
    return sorted(
        path
        for path in folder.rglob("*")
        if (path.is_symlink() or not path.is_dir()) and "__pycache__" not in path.parts
    )


def rows_of(folder: Path) -> dict[CellIdentity, pa.Table]:
    """Return the episodes of every cell of a submission, in the order of the file. Raises
    StoreError where they cannot be read.
    """
    table = read_episodes([folder / ROWS])
    names = list(CellIdentity.__dataclass_fields__)
    places: dict[CellIdentity, list[int]] = {}
    for place, row in enumerate(table.select(names).to_pylist()):
        places.setdefault(CellIdentity(**row), []).append(place)
    return {identity: table.take(found) for identity, found in places.items()}


@contextmanager
def new_folder(place: Path, *, force: bool) -> Iterator[Path]:
    """Yield an empty folder beside a place, and move it there when the block ends: the place then
    has all of it, or what it had before.

    Raises:
        UsageError: something is there, and `force` is not set; or what is there is no submission.
    """
    require_free(place, force=force)
    place.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
    try:
        staging.chmod(0o755)  # mkdtemp's folder is for its owner alone
        yield staging
        require_free(place, force=force)
        if place.exists():
            shutil.rmtree(place)
        os.replace(staging, place)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def require_free(place: Path, *, force: bool) -> None:
    """Raise a UsageError where a submission must not be written."""
    if not os.path.lexists(place):
        return
    if not force:
        raise UsageError(f"'{place}' is there already", "--force replaces it, --out names another")
    if place.is_symlink() or not is_submission(place):
        raise UsageError(f"'{place}' is no submission, and is not replaced", "name another folder")


def complete(folder: Path, submission: Mapping[str, Any]) -> None:
    """Write `submission.json` over the other files of a folder, whose digests it lists."""
    files = {path.relative_to(folder).as_posix(): file_digest(path) for path in _files(folder)}
    write_record(folder / SUBMISSION, asdict(Submission(**{**submission, "files": files})))
