"""Chooses the published results that replace nodes.

A node may be replaced by a published result of the same recipe: the same configuration, perhaps
under other code. Its key is then that of the published result, so that the keys of nodes that are
computed from it contain what they were computed from.

Results in the store under today's code come first. Results of other code replace nodes together if
they belong together: a critic is used with the world model whose latents it was trained on. A node
that has to be computed therefore never reads two versions of one recipe, neither directly nor
through its inputs. Held-out rows are an exception: parts are judged and thresholds set on them, but
nothing is trained on them, so they may be recorded again. A published result that nothing reads,
such as the rows of a cell, may come from any version.

If a published cell has more episodes than are asked for, its first ones are taken (`--limit`).
"""

from __future__ import annotations

import gc
import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from wasp_cli.errors import UsageError
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import Grid, lay_out
from wasp_cli.plan.keys import LENGTH
from wasp_cli.plan.node import Node
from wasp_cli.plan.offered import Listing, digests_kept, episodes_of
from wasp_cli.plan.reasons import few, moved_on
from wasp_cli.spec.load import with_episodes
from wasp_cli.spec.model import Spec
from wasp_cli.spec.shipped import published_folder
from wasp_cli.store.artifact import artifact_keys, exists
from wasp_cli.store.layout import Layout
from wasp_cli.store.published import (
    EARLIER,
    Offer,
    Reused,
    commit_of,
    not_used,
    why_unusable,
)
from wasp_cli.store.reached import reached
from wasp_cli.store.slim import STEPS_FILE, without_steps

NONE, PUBLISHED = "none", "published"  # what may be reused; or the published folder of someone else
HELDOUT = "heldout"
"""The kind of which there may be two versions: too large to be published, it would keep
everything trained beside it from being reused.
"""


def layer_of(layout: Layout, choice: str) -> Layout | None:
    """Return the published layer that `--reuse` or a spec names; None without reuse."""
    if choice == NONE:
        return None
    if choice == PUBLISHED:
        own, shipped = Layout(layout.within(layout.published)), published_folder()
        # A new results folder has none: then those that come with the package.
        return own if own.store.is_dir() or shipped is None else Layout(shipped)
    layer = Layout(Path(choice).absolute())
    recipes = recipes_in(layer)
    if not choice.strip() or not recipes or not all(recipes):
        raise UsageError(
            f"'{choice}' is no folder of published results",
            "use none, published, or a folder that wasp publish has filled",
        )
    return layer


def recipes_in(layer: Layout) -> list[bool]:
    """Yield for each artifact of a folder whether its manifest is a published one. In an ordinary
    results folder only reused artifacts have such manifests.
    """
    return [entry.published for entry in Listing(layer).entries if entry.published is not None]


def lay_out_over(spec: Spec, layout: Layout, reuse: str | None = None) -> Grid:
    """Return the grid of a spec with published results in place of nodes. The results folder need
    not exist.
    """
    gc.disable()  # of a million objects of syntax trees and manifests none is garbage
    try:
        return _laid_out_over(spec, layout, reuse)
    finally:
        gc.enable()


def _laid_out_over(spec: Spec, layout: Layout, reuse: str | None) -> Grid:
    source = layer_of(layout, spec.reuse if reuse is None else reuse)
    own = lay_out(spec)
    if source is None:
        return own
    listing = Listing(source)
    first, uncut = _first_episodes(spec, own, listing, layout)
    offered = listing.offers({node.recipe for node in own.nodes})
    if not listing.usable:
        return replace(own, notes=tuple(listing.notes))
    with digests_kept(source):
        usable, notes = _usable(own, [*offered, *first], layout)
    chosen = choose(own, usable)
    keys = {recipe: offer.key for recipe, offer in chosen.items()}
    current = {node.recipe: node.key for node in own.nodes}
    grid = (
        lay_out(spec, keys) if any(current[recipe] != key for recipe, key in keys.items()) else own
    )
    reused = {
        node.key: Reused(offer, *_code_of(node, offer, current=current[node.recipe] == node.key))
        for node in grid.nodes
        if (offer := chosen.get(node.recipe)) is not None
    }
    return replace(grid, reused=reused, notes=(*listing.notes, *notes, *uncut))


def _usable(own: Grid, offered: Iterable[Offer], layout: Layout) -> tuple[list[Offer], list[str]]:
    nodes = {node.recipe: node for node in own.nodes}
    recipes = {node.key: node.recipe for node in own.nodes}
    usable, notes = [], []
    stored = cache(partial(_stored, layout))
    for offer in offered:
        node = nodes.get(offer.recipe)
        if (
            node is None
            or node.kind != offer.kind
            or (
                node.key != offer.key
                and node.key in stored(node.kind)
                and exists(layout, node.kind, node.key)
            )
        ):
            continue
        other = recipes.get(offer.key, offer.recipe) != offer.recipe
        why = "it has the key of another node" if other else why_unusable(offer, layout)
        if why is None:
            usable.append(offer)
        else:
            notes.append(not_used(offer.kind, offer.source_key, why))
    return usable, notes


def _stored(layout: Layout, kind: str) -> set[str]:
    """The keys of a kind that have a folder, which is faster to find out than what is in it."""
    return set(artifact_keys(layout, kind))


def _first_episodes(
    spec: Spec, own: Grid, listing: Listing, layout: Layout
) -> tuple[list[Offer], list[str]]:
    """The first episodes of published cells that have more, and notes on cells whose first episodes
    cannot be taken.

    Products of matrices may round differently with another number of rows, so only whole batches of
    `side_by_side` episodes are the same in a smaller cell.
    """
    episodes = spec.episodes
    lengths = {entry.episodes for entry in listing.cells if entry.episodes > episodes}
    longer_ones: list[tuple[Node, Node, Offer]] = []
    for length in sorted(lengths):
        whole = lay_out(with_episodes(spec, length))
        published: dict[str, list[Offer]] = {}
        for offer in listing.offers({node.recipe for _, node in whole.cells}):
            if episodes_of(offer) == length and STEPS_FILE in offer.manifest["files"]:
                published.setdefault(offer.recipe, []).append(offer)
        for (cell, node), (_, longer) in zip(own.cells, whole.cells, strict=True):
            if cell.operator != PERSON:
                longer_ones += [(node, longer, offer) for offer in published.get(longer.recipe, ())]
    if episodes % spec.side_by_side:
        if all(exists(layout, node.kind, node.key) for node, _, _ in longer_ones):
            return [], []
        why = f"a cell is cut after whole batches of {spec.side_by_side} (side_by_side)"
        return [], [f"the first {episodes} episodes of published cells are computed: {why}"]
    return [_first_of(node, longer, offer, node.recipe) for node, longer, offer in longer_ones], []


def _first_of(node: Node, longer: Node, offer: Offer, recipe: str) -> Offer:
    episodes = int(node.config["episodes"])
    # Under today's code it has the key that it would have been computed under; under other code,
    # one that says what it was cut from.
    key = (
        node.key
        if offer.key == longer.key
        else hashlib.sha256(f"first {episodes} of {offer.key}".encode()).hexdigest()[:LENGTH]
    )
    provenance: dict[str, Any] = {**offer.manifest["provenance"], EARLIER: offer.key}
    seconds = provenance.get("seconds")
    if isinstance(seconds, int | float):
        provenance["seconds"] = round(seconds * episodes / episodes_of(offer), 3)
    manifest = {
        **offer.manifest,
        "key": key,
        "config": dict(node.config),
        "recipe": recipe,
        "provenance": provenance,
    }
    return replace(offer, key=key, recipe=recipe, manifest=manifest, episodes=episodes)


def choose(own: Grid, offered: Iterable[Offer]) -> dict[str, Offer]:
    """Return, by recipe, the published results that are reused.

    If there are several, one of today's code comes first, then one that was computed from other
    results that are reused, then the newest.
    """
    by_recipe: dict[str, list[Offer]] = {}
    for offer in offered:
        by_recipe.setdefault(offer.recipe, []).append(offer)
    chosen: dict[str, Offer] = {}
    keys: dict[str, str] = {}

    def preference(offer: Offer, key: str) -> tuple[bool, bool, str, str]:
        fits = all(keys.get(recipe) == needed for recipe, needed in offer.behind.items())
        return offer.key == key, fits, offer.started_at, offer.key

    for node in own.nodes:  # needed ones first
        keys[node.recipe] = node.key
        if node.recipe in by_recipe:
            chosen[node.recipe] = max(
                by_recipe[node.recipe], key=lambda offer: preference(offer, node.key)
            )
            keys[node.recipe] = chosen[node.recipe].key
    while wrong := set(_conflicts(own, chosen)):
        chosen = {recipe: offer for recipe, offer in chosen.items() if recipe not in wrong}
    return chosen


def _conflicts(own: Grid, chosen: Mapping[str, Offer]) -> Iterator[str]:
    """The recipes of results that must not be reused: through them a node that is computed would
    read two versions of something, or steps that were left out of a slim cell.
    """
    keys, targets = _keys_with(own, chosen), own.targets
    # What is needed for reused results alone is not computed.
    computed = {
        node
        for node in _looked_at((node for node in own.nodes if node.key in targets), chosen)
        if node.recipe not in chosen
    }
    read = {needed.key for node in own.nodes for needed in node.needs.values()}
    free = {node.recipe for node in own.nodes if node.kind == HELDOUT}
    # by recipe of a node that others read, the versions behind it and its own, by recipe
    versions: dict[str, Mapping[str, str]] = {}
    judged: set[int] = set()
    for node in own.nodes:
        if node.recipe in chosen:
            versions[node.recipe] = {**chosen[node.recipe].behind, node.recipe: keys[node.recipe]}
            continue
        # the cells of an assistant share what they read
        if node not in computed or (node.key not in read and id(node.needs) in judged):
            continue
        judged.add(id(node.needs))
        merged: dict[str, str] = {}
        twofold: set[str] = set()
        for needed in node.needs.values():
            if needed.recipe in chosen and without_steps(chosen[needed.recipe].manifest):
                yield needed.recipe
            twofold |= {
                recipe
                for recipe, key in versions[needed.recipe].items()
                if merged.setdefault(recipe, key) != key
            }
        versions[node.recipe] = {**merged, node.recipe: keys[node.recipe]}
        if twofold := twofold - free:
            # The reused results that the node reads, directly or through what is computed for it.
            for recipe in {
                near.recipe for near in _looked_at(node.needs.values(), chosen)
            } & chosen.keys():
                behind = chosen[recipe].behind
                if any(name in behind and behind[name] != keys.get(name) for name in twofold):
                    yield recipe


def _looked_at(nodes: Iterable[Node], chosen: Mapping[str, Offer]) -> set[Node]:
    """The nodes, and what is read for them: of a reused result nothing is."""
    return reached(nodes, lambda node: () if node.recipe in chosen else node.needs.values())


def _keys_with(own: Grid, chosen: Mapping[str, Offer]) -> dict[str, str]:
    """By recipe, the key that a node would have. A node that is to be computed from other versions
    gets a placeholder.
    """
    keys: dict[str, str] = {}
    for node in own.nodes:
        same = all(keys[needed.recipe] == needed.key for needed in node.needs.values())
        current = node.key if same else f"new {node.recipe}"
        keys[node.recipe] = chosen[node.recipe].key if node.recipe in chosen else current
    return keys


def _code_of(node: Node, offer: Offer, *, current: bool) -> tuple[str, str]:
    """Which code computed a published result, and what has changed since."""
    first = "" if offer.episodes is None else f"the first {offer.episodes} episodes, "
    changes = moved_on(node, offer.manifest)
    if not changes and current:
        return f"{first}published with this code", ""
    details = (
        f"changed since: {few(changes)}"
        if changes
        else "its inputs were computed by another version"
    )
    return f"{first}published by another version of this code{commit_of(offer.manifest)}", details
