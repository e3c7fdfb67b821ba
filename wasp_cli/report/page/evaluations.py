"""The evaluations behind a report: when and by which version each was computed, and the commands that open its episodes."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from wasp_cli.errors import WaspError
from wasp_cli.report.node import mapping
from wasp_cli.report.provenance import commit_of
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity


class Evaluation(NamedTuple):
    """One evaluated cell."""

    label: str
    key: str
    date: str
    """when it was computed, UTC to the minute; empty where its manifest does not say"""
    version: str
    """which version computed it, with its commit"""
    commands: tuple[str, ...]
    """that open its first episode, as a shell reads them"""


def evaluations_of(layout: Layout, keys: Mapping[CellIdentity, str], limit: int) -> Iterator[Evaluation]:
    """Yield what is known of each of the first `limit` evaluations that are there.

    Args:
        layout: the results folder.
        keys: of the evaluations.
        limit: manifests that are read at most: a large grid has thousands.
    """
    place = "" if layout.root == Path("results") else f" --results {shlex.quote(str(layout.root))}"
    for key in islice(keys.values(), limit):
        try:
            manifest = read_manifest(layout, KIND, key)
        except WaspError:
            continue  # named among what is missing or damaged
        provenance = mapping(manifest.get("provenance"))
        date = str(provenance.get("started_at") or "")[:16].replace("T", " ")
        version = f"wasp {provenance['wasp']}{commit_of(manifest)}" if "wasp" in provenance else "not known"
        commands = tuple(f"wasp {name} {key[:8]} --episode 0{place}" for name in ("explain", "replay"))
        yield Evaluation(str(manifest.get("label") or key), key, date, version, commands)
