"""Cells whose episodes are the first ones of published cells: these are cut, not computed.

Products of matrices may round by the number of rows. The first rows of a cell are therefore those of a smaller one only where whole batches
of `side_by_side` episodes are taken.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import Grid, lay_out
from wasp_cli.plan.keys import LENGTH
from wasp_cli.plan.node import Node
from wasp_cli.spec.model import Spec
from wasp_cli.store.cut import CUT_FROM
from wasp_cli.store.published import Offer
from wasp_cli.store.slim import STEPS_FILE

CELL_FILES = {"episodes.parquet", STEPS_FILE}
"""Of a cell that can be cut."""


def with_episodes(spec: Spec, episodes: int) -> Spec:
    """Return a spec with so many episodes in each cell."""
    evaluate = spec.stage("evaluate").model_copy(update={"episodes": episodes})
    return spec.model_copy(update={"episodes": episodes, "evaluate": evaluate})


def first_episodes(spec: Spec, own: Grid, offered: Sequence[Offer]) -> tuple[list[Offer], list[str]]:
    """Return what can be cut from published cells with more episodes, and what a plan says where nothing can.

    Args:
        spec: what is asked for.
        own: its grid, with recipes and without reuse.
        offered: what is published.
    """
    episodes = spec.episodes
    published: dict[str, list[Offer]] = {}
    for offer in offered:
        if offer.kind == "evaluate" and _episodes(offer) > episodes and set(offer.manifest["files"]) == CELL_FILES:
            published.setdefault(offer.recipe, []).append(offer)
    found: list[tuple[Node, Node, Offer]] = []
    for length in sorted({_episodes(offer) for offers in published.values() for offer in offers}):
        whole = lay_out(with_episodes(spec, length), {})
        for (cell, node), (_, longer) in zip(own.cells, whole.cells, strict=True):
            if cell.operator != PERSON:
                found += [(node, longer, offer) for offer in published.get(whole.recipes[longer.key], ())]
    if found and episodes % spec.side_by_side:
        why = f"a cell is cut after whole batches of {spec.side_by_side} (side_by_side)"
        return [], [f"the first {episodes} episodes of published cells are computed: {why}"]
    return [_cut(node, longer, offer, own.recipes[node.key]) for node, longer, offer in found], []


def _episodes(offer: Offer) -> int:
    config = offer.manifest.get("config")
    count = config.get("episodes") if isinstance(config, dict) else None
    return count if isinstance(count, int) else 0


def _cut(node: Node, longer: Node, offer: Offer, recipe: str) -> Offer:
    """The offer of the first episodes of a published cell."""
    episodes = int(node.config["episodes"])
    # Under today's code it has the key that it would have been computed under; under other code, one that says what it was cut from.
    key = node.key if offer.key == longer.key else hashlib.sha256(f"first {episodes} of {offer.key}".encode()).hexdigest()[:LENGTH]
    provenance: dict[str, Any] = {**offer.manifest["provenance"], CUT_FROM: offer.key}
    seconds = provenance.get("seconds")
    if isinstance(seconds, int | float):
        provenance["seconds"] = round(seconds * episodes / _episodes(offer), 3)
    manifest = {**offer.manifest, "key": key, "config": dict(node.config), "recipe": recipe, "provenance": provenance}
    return replace(offer, key=key, recipe=recipe, manifest=manifest, episodes=episodes)
