"""The published layer: artifacts that lie in git, for runs that ask for the same configuration on a
machine that has not computed it.

It is laid out as a results folder, with `store/` and `reports/`. A manifest there has two further
entries: `recipe`, the configuration without the code that computed it, and `behind`, by recipe, the
keys of everything that it was computed from. Its author need not be trusted: the form of a manifest
is checked before anything else of the artifact is read, and nothing is used whose bytes are not
those of its manifest.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wasp_cli.errors import ArtifactError, described
from wasp_cli.store import artifact
from wasp_cli.store.layout import MANIFEST, Layout, is_key
from wasp_cli.store.lock import held
from wasp_cli.store.plain import open_plain
from wasp_cli.store.slim import SLIM, first_episodes

# entries of a published manifest that one of the store does not have
RECIPE = "recipe"
BEHIND = "behind"
# in the provenance of a cell: the key of the one whose rows it took over. Its time then does not
# tell how long such a cell takes.
EARLIER = "earlier"
# set in the provenance of an artifact that was brought into the store from the published layer
FROM_PUBLISHED = "published"

SHA_LENGTH = 7  # hexadecimal digits of a commit that people are shown


@dataclass(frozen=True)
class Offer:
    """A published artifact that may stand in the place of a node."""

    source: Layout  # the published layer
    kind: str
    key: str
    recipe: str
    behind: Mapping[str, str]  # by recipe, the key of everything that it was computed from
    manifest: Mapping[str, Any]
    episodes: int | None = None
    """How many of the first episodes of a published cell are taken; None: the whole artifact. `key`
    is then that of the shorter cell.
    """

    @property
    def source_key(self) -> str:
        """The key in the published layer, which differs for the first episodes of a cell."""
        return str(self.manifest["provenance"][EARLIER]) if self.episodes is not None else self.key

    @property
    def started_at(self) -> str:
        """When it was computed, as a text that sorts by time; empty where that is unknown."""
        return str(self.manifest["provenance"].get("started_at", ""))


@dataclass(frozen=True)
class Reused:
    """A published artifact that stands in the place of a node."""

    offer: Offer
    reason: str  # which code computed it, for people
    details: str = ""  # what has changed since


def commit_of(manifest: Mapping[str, Any]) -> str:
    """Return the commit that an artifact was computed with, for people; empty when unknown."""
    git = manifest["provenance"].get("git")
    if not isinstance(git, dict) or not isinstance(git.get("sha"), str):
        return ""
    return f" (git {git['sha'][:SHA_LENGTH]}{' with changes' if git.get('dirty') else ''})"


def not_used(kind: str, key: str, why: str) -> str:
    """Return what a plan and a run say of a published artifact that they leave alone."""
    return f"published {kind}/{key} is not used: {why}"


# by path, with time, size and inode: a sweep plans again and again
_manifests: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {}


def manifest_of(source: Layout, kind: str, key: str) -> Mapping[str, Any]:
    """Return the manifest of a published artifact. A process reads it once, as long as its file
    stays the same.
    """
    path = source.manifest(kind, key)
    with suppress(OSError):
        state = path.lstat()
        stamp = state.st_mtime_ns, state.st_size, state.st_ino
        entry = _manifests.get(str(path))
        if entry is not None and entry[0] == stamp:
            return entry[1]
        manifest = artifact.read_manifest(source, kind, key)
        _manifests[str(path)] = (stamp, manifest)
        return manifest
    return artifact.read_manifest(source, kind, key)  # raises what is wrong


def offer_of(source: Layout, kind: str, key: str) -> Offer:
    """Return a published artifact, after a check of its manifest; no other file is looked at.
    Raises ArtifactError where the manifest is not one of ours.
    """
    manifest = manifest_of(source, kind, key)
    path = source.manifest(kind, key)
    # Its files.
    if MANIFEST in artifact.listed_files(manifest, path):
        raise ArtifactError(f"'{path}' is damaged: it lists itself")
    # What it is the result of.
    recipe = manifest.get(RECIPE)
    behind = manifest.get(BEHIND)
    texts = [recipe, *behind.keys(), *behind.values()] if isinstance(behind, dict) else []
    named = manifest.get("kind") == kind and manifest.get("key") == key
    are_keys = all(isinstance(text, str) and is_key(text) for text in texts)
    if not named or not texts or not are_keys:
        raise ArtifactError(f"'{path}' is damaged: it does not say what it is the result of")
    # Which code computed it.
    has_provenance = isinstance(manifest.get("provenance"), dict)
    has_sources = isinstance(manifest.get("sources"), dict)
    if not has_provenance or not has_sources:
        raise ArtifactError(f"'{path}' is damaged: it does not say what code computed it")
    # published before weights were rounded at the end of training
    if "half precision" in str(manifest.get(SLIM)):
        raise ArtifactError(f"'{path}' has other weights than its cells were computed with")
    return Offer(source, kind, key, str(recipe), dict(behind or {}), manifest)


def why_unusable(offer: Offer, layout: Layout) -> str | None:
    """Return what is wrong with the bytes of a published artifact; None where nothing is, or where
    the store has the artifact already.
    """
    if artifact.exists(layout, offer.kind, offer.key):
        return None
    key = offer.source_key
    try:
        sizes = artifact.listed_files(offer.manifest, offer.source.manifest(offer.kind, key))
        wrong = artifact.missing_file(offer.source, offer.kind, key, sizes)
        return wrong or artifact.changed_file(offer.source, offer.kind, key, offer.manifest)
    except (ArtifactError, OSError, AttributeError) as error:  # it changes now, or names no digests
        return str(error)


def import_artifact(layout: Layout, offer: Offer, waiting: Callable[[], bool]) -> None:
    """Copy a published artifact into the store, or the first episodes of a cell, unless it is there
    already. `waiting` is that of `lock.held`.

    Raises:
        ArtifactError: a file has other bytes than its manifest says, or its rows cannot be read.
        Busy: someone else is computing it, and `waiting` returned False.
    """
    with held(layout.lock(offer.key), waiting):
        if artifact.exists(layout, offer.kind, offer.key):
            return
        staging = artifact.staging_folder(layout, offer.key)
        try:
            copy_files(offer.source, offer.kind, offer.source_key, offer.manifest, staging)
            manifest = {
                **offer.manifest,
                "provenance": {**offer.manifest["provenance"], FROM_PUBLISHED: True},
            }
            if offer.episodes is not None:
                import pyarrow as pa

                try:
                    manifest["summary"] = first_episodes(staging, offer.episodes)
                except (pa.ArrowException, LookupError, TypeError, ValueError) as error:
                    message = (
                        f"published {offer.kind}/{offer.source_key} cannot be read: "
                        f"{described(error)}"
                    )
                    raise ArtifactError(message, "run with --reuse none") from error
            artifact.commit(layout, offer.kind, offer.key, staging, manifest, copied=True)
        except BaseException:
            artifact.discard(staging)
            raise


def copy_files(
    source: Layout, kind: str, key: str, manifest: Mapping[str, Any], folder: Path
) -> None:
    """Copy the files that a manifest lists, and nothing else that lies beside it. Raises
    ArtifactError where one has other bytes than the manifest says.
    """
    for name in artifact.listed_files(manifest, source.manifest(kind, key)):
        path = source.within(source.artifact(kind, key) / name)
        copy = folder / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        with open_plain(path) as file, copy.open("wb") as written:
            shutil.copyfileobj(file, written)
        if artifact.file_digest(copy) != manifest["files"][name].get("sha256"):
            raise ArtifactError(f"'{path}' has other bytes than were stored")
