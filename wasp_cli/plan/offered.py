"""What a published layer offers to a plan, from an index of its manifests. A manifest is read only
if its recipe is needed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Container, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from wasp_cli.errors import ArtifactError
from wasp_cli.plan.index import Index, Row, is_settled, name_of
from wasp_cli.spec import kept
from wasp_cli.store import artifact
from wasp_cli.store.layout import Layout
from wasp_cli.store.published import RECIPE, Offer, manifest_of, not_used, offer_of

CELL = "evaluate"
DIGESTS = "digests"  # the name under which the digests of published files are kept


@dataclass(frozen=True, slots=True)
class Listed:
    """What a plan wants to know of every published artifact."""

    kind: str
    key: str
    recipe: str  # empty where the manifest is damaged
    episodes: int  # of a cell; 0 of others
    published: bool | None  # whether its manifest is a published one; None where it has none
    problem: str  # why it cannot be used; empty where nothing is wrong with its manifest


class Listing:
    """The artifacts of a published layer that have a manifest."""

    def __init__(self, source: Layout) -> None:
        self._source = source
        index = Index(source, "published", (sys.modules[__name__],), partial(_row, source))
        self.entries = [
            Listed(kind, key, *row)
            for kind in artifact.stored_kinds(source)
            for key, row in index.rows(kind).items()
        ]
        index.save()
        # A key is one node; two of one name would take each other's place.
        by_key: dict[str, list[Listed]] = {}
        self.notes: list[str] = []
        """What a plan says of those that cannot be used."""
        for entry in self.entries:
            if entry.problem:
                self.notes.append(not_used(entry.kind, entry.key, entry.problem))
            else:
                by_key.setdefault(entry.key, []).append(entry)
        self.usable: list[Listed] = []
        """Those with whose manifest nothing is wrong."""
        for same in by_key.values():
            if len(same) == 1:
                self.usable += same
        for key in sorted(key for key, same in by_key.items() if len(same) > 1):
            self.notes.append(not_used(by_key[key][-1].kind, key, "two kinds have this key"))

    @property
    def cells(self) -> list[Listed]:
        """The evaluated cells that can be used."""
        return [entry for entry in self.usable if entry.kind == CELL]

    def offers(self, recipes: Container[str] | None = None) -> list[Offer]:
        """Return the artifacts of some recipes, or of all. Those that change at this moment are
        left out, with a note.
        """
        found: list[Offer] = []
        for entry in self.usable:
            if recipes is None or entry.recipe in recipes:
                try:
                    found.append(offer_of(self._source, entry.kind, entry.key))
                except ArtifactError as error:
                    self.notes.append(not_used(entry.kind, entry.key, error.message))
        return found


def _row(source: Layout, kind: str, key: str) -> Row | None:
    """The further fields of a `Listed`; None where there is no manifest."""
    if not source.manifest(kind, key).is_file():
        return None
    recipe = ""
    episodes = 0
    published = None
    problem = ""
    try:
        manifest = manifest_of(source, kind, key)
        if manifest:  # an empty one is damaged
            published = RECIPE in manifest
        offer = offer_of(source, kind, key)
        recipe = offer.recipe
        episodes = episodes_of(offer)
    except ArtifactError as error:
        problem = error.message
    return [recipe, episodes, published, problem]


def episodes_of(offer: Offer) -> int:
    """Return the number of episodes of a published cell; 0 for anything else."""
    config = offer.manifest.get("config")
    count = config.get("episodes") if isinstance(config, dict) else None
    return count if isinstance(count, int) else 0


@contextmanager
def digests_kept(source: Layout) -> Iterator[None]:
    """Within the block, do not read the bytes of published files that an earlier plan has compared
    with their manifests, as long as the files stay the same; and keep what is read in it.

    A run compares them again when it copies them.
    """
    name = name_of(DIGESTS, source)
    version = kept.code_version(artifact)
    before = kept.read_kept(name, version)
    artifact.take_as_verified(
        {path: (_stamp(stamp), digest) for path, (stamp, digest) in before.items()}
    )
    begun = time.time_ns()
    yield
    now: dict[str, Any] = {
        path: [list(stamp), digest]
        for path, (stamp, digest) in artifact.verified_below(source.store).items()
        if is_settled(stamp, begun)
    }
    if now != before:
        kept.keep(name, version, now)


def forget_digests(source: Layout) -> None:
    """Forget that the bytes of published files were compared, so that the next plan reads them
    again.
    """
    kept.forget(name_of(DIGESTS, source), kept.code_version(artifact))


def _stamp(values: list[int]) -> artifact.Stamp:
    inode, size, written, changed = values
    return inode, size, written, changed
