"""What a plan reads from manifests: how long nodes took, and earlier versions of nodes, from which
it finds out why a node is computed again.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass
from functools import partial
from statistics import median
from typing import Any

from pydantic import ValidationError

from wasp_cli.errors import ArtifactError
from wasp_cli.plan import keys, node
from wasp_cli.plan.grid import stage_class
from wasp_cli.plan.index import Index, Row
from wasp_cli.plan.keys import canonical, digest, libraries, minor
from wasp_cli.plan.node import Node, sort_of
from wasp_cli.plan.source import source_hashes
from wasp_cli.store.artifact import listed_files, missing_file, read_manifest, why_invalid
from wasp_cli.store.layout import Layout
from wasp_cli.store.published import EARLIER, FROM_PUBLISHED
from wasp_cli.store.slim import without_steps
from wasp_cli.tasks.foreign.assets import MARK, is_data


@dataclass(frozen=True, slots=True)
class Facts:
    """What a plan wants to know of a stored artifact. Nothing of one whose manifest has another
    form.
    """

    who: str = ""  # the same for all versions of one node
    sort: str = ""  # as `Node.sort`
    signature: str = ""  # the same for versions that differ from a node in the same way
    # what it took; None of what took rows over or was published: its like takes another time here
    seconds: float | None = None
    at: str = ""
    episodes: int = 0
    cut: bool = False  # whether steps of a cell were left out, so that nothing is computed from it


def facts_of(manifest: Mapping[str, Any]) -> Facts:
    """Return what a plan compares of a manifest; empty facts if the manifest has another form."""
    try:
        provenance, axes, config = (manifest[name] for name in ("provenance", "axes", "config"))
        differing = [manifest[name] for name in ("config", "settings", "sources", "upstream")]
        return Facts(
            who(str(manifest["kind"]), str(manifest["task"]), int(manifest["seed"]), axes),
            sort_of(manifest["kind"], manifest["task"], config, axes),
            digest([*differing, axes.get("method_config"), provenance.get("versions")]),
            None
            if EARLIER in provenance or provenance.get(FROM_PUBLISHED)
            else float(provenance["seconds"]),
            str(provenance.get("started_at", "")),
            int(config.get("episodes", 0)),
            without_steps(manifest),
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return Facts()


@dataclass(frozen=True)
class Stored:
    """What a results folder has."""

    whole: Mapping[str, Mapping[str, Facts]]  # by kind and key
    damaged: Mapping[str, str]


def look_at(layout: Layout, kinds: Iterable[str]) -> Stored:
    """Return what a store has of some kinds."""
    index = Index(layout, "facts", (keys, node, sys.modules[__name__]), partial(_row, layout))
    whole: dict[str, dict[str, Facts]] = {}
    damaged: dict[str, str] = {}
    for kind in kinds:
        whole[kind] = {}
        for key, (problem, sizes, facts) in index.rows(kind).items():
            wrong = problem or missing_file(layout, kind, key, sizes)
            if wrong is None:
                whole[kind][key] = Facts(*facts)
            else:
                damaged[key] = why_invalid(layout, kind, key) or wrong
    index.save()
    return Stored(whole, damaged)


def _row(layout: Layout, kind: str, key: str) -> Row:
    """What is wrong with a manifest, the size of each file that it lists, and its facts."""
    try:
        manifest = read_manifest(layout, kind, key)
        sizes = listed_files(manifest, layout.manifest(kind, key))
    except ArtifactError as error:
        return [error.message, {}, []]
    return [None, sizes, list(astuple(facts_of(manifest)))]


def who(kind: str, task: str, seed: int, axes: Mapping[str, Any]) -> str:
    """Return the identity of a node without its configuration: who assists whom, where, with
    which seed.
    """
    method = axes.get("method_config")
    variant = method.get("variant") if isinstance(method, Mapping) else None
    return (
        f"{kind} {task} {seed} {axes.get('method')} {variant} {axes.get('operator')} "
        f"{axes.get('value')!r}"
    )


def measured(stored: Stored) -> dict[str, float]:
    """Return the median seconds of each sort of node that was computed here."""
    times: dict[str, list[float]] = {}
    for artifacts in stored.whole.values():
        for facts in artifacts.values():
            if facts.seconds is not None:
                times.setdefault(facts.sort, []).append(facts.seconds)
    return {sort: median(values) for sort, values in times.items()}


NEWEST = 5  # earlier versions that are looked at for the nearest one
NAMED = 3  # changes of one kind that a reason names
_ABSENT = object()


class Reasons:
    """Finds the nearest earlier version of a node, and what has changed since."""

    def __init__(self, layout: Layout, stored: Stored) -> None:
        self._layout = layout
        self._versions: dict[str, list[tuple[str, Facts]]] = {}
        """By `who`, the key and the facts of every version in the store, newest first."""
        for artifacts in stored.whole.values():
            for key, facts in sorted(artifacts.items(), key=lambda item: item[1].at, reverse=True):
                self._versions.setdefault(facts.who, []).append((key, facts))
        self._known: dict[tuple[object, ...], tuple[int, str]] = {}
        """By what was compared: nodes that share their configuration differ from versions that
        share theirs in the same way.
        """

    def of(self, node: Node) -> str | None:
        """Return what changed since the nearest earlier version of a node; None if there is
        none.
        """
        compared = [
            self._difference(node, key, facts) for key, facts in self._versions_of(node)[:NEWEST]
        ]
        differences = [difference for difference in compared if difference is not None]
        return min(differences, key=lambda difference: difference[0])[1] if differences else None

    def beginning(self, node: Node) -> str | None:
        """Return the key of the stored cell with which this one begins: it has fewer episodes, at
        least one whole batch of them, and nothing else is different.
        """
        batch = node.settings["side_by_side"]
        fewer = [
            (facts.episodes, key)
            for key, facts in self._versions_of(node)
            if batch <= facts.episodes < node.config["episodes"]
        ]
        return next(
            (key for _, key in sorted(fewer, reverse=True) if self._begins(node, key)), None
        )

    def _versions_of(self, node: Node) -> list[tuple[str, Facts]]:
        return self._versions.get(who(node.kind, node.task, node.seed, node.axes), [])

    def _begins(self, node: Node, key: str) -> bool:
        with suppress(ArtifactError, KeyError, TypeError, ValueError, AttributeError):
            manifest = read_manifest(self._layout, node.kind, key)
            before = [
                {**manifest["config"], "episodes": None},
                *(manifest[name] for name in ("settings", "axes", "upstream")),
            ]
            upstream = {name: needed.key for name, needed in node.needs.items()}
            now = [{**node.config, "episodes": None}, node.settings, node.axes, upstream]
            return canonical(before) == canonical(now) and not moved_on(node, manifest)
        return False

    def _difference(self, node: Node, key: str, facts: Facts) -> tuple[int, str] | None:
        method = node.axes.get("method_config")
        # Identity is enough: the grid builds each of these once.
        pair = (
            facts.signature,
            id(node.config),
            id(node.settings),
            id(method),
            id(node.needs),
            node.modules,
            node.without,
        )
        if pair not in self._known:
            with suppress(ArtifactError, KeyError, TypeError, ValueError, AttributeError):
                self._known[pair] = _compared(node, read_manifest(self._layout, node.kind, key))
        return self._known.get(pair)


def _compared(node: Node, manifest: Mapping[str, Any]) -> tuple[int, str]:
    model = stage_class(node.kind).config
    try:
        before, now = (
            model.model_validate(values).identity() for values in (manifest["config"], node.config)
        )
    except ValidationError:  # written by a version with other fields
        before = manifest["config"]
        now = dict(node.config)
    sections = (before, manifest["settings"], manifest["axes"]), (now, node.settings, node.axes)
    fields = list(_fields(node.kind, *sections))
    modules = _modules(source_hashes(node.modules, node.without), manifest["sources"])
    versions = library_changes(manifest)
    parts = _words(fields, modules, versions)
    if not parts:
        upstream = manifest["upstream"]
        changed = [name for name, needed in node.needs.items() if upstream.get(name) != needed.key]
        parts = [f"upstream changed: {few(changed)}"]
    return len(fields) + len(modules) + len(versions), "; ".join(parts)


def _words(fields: Sequence[str], modules: Sequence[str], versions: Sequence[str]) -> list[str]:
    code = [name for name in modules if not is_data(name)]
    data = [name.partition(MARK)[2] for name in modules if is_data(name)]
    changes = {"spec": fields, "code": code, "data": data, "library": versions}
    return [f"{what} changed: {few(items)}" for what, items in changes.items() if items]


def changes_between(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Return what differs between two versions of a node by their manifests: configuration,
    code and libraries, not what they read.
    """
    sections = (
        [manifest[name] for name in ("config", "settings", "axes")] for manifest in (before, after)
    )
    fields = list(_fields(after["kind"], *sections))
    older, newer = ((manifest["provenance"].get("versions") or {}) for manifest in (before, after))
    return _words(
        fields, _modules(after["sources"], before["sources"]), list(_differing(older, newer, ""))
    )


def moved_on(node: Node, manifest: Mapping[str, Any]) -> list[str]:
    """Return which modules and libraries differ from those that computed a node."""
    return _modules(
        source_hashes(node.modules, node.without), manifest["sources"]
    ) + library_changes(manifest)


def library_changes(manifest: Mapping[str, Any]) -> list[str]:
    """Return which libraries have other versions than in a manifest."""
    recorded = manifest["provenance"].get("versions")
    installed = recorded if isinstance(recorded, Mapping) else {}
    return [
        f"{name} {old} -> {new}"
        for name, new in libraries().items()
        if (old := minor(installed.get(name))) != new
    ]


def _fields(
    kind: str, before: Sequence[Mapping[str, Any]], now: Sequence[Mapping[str, Any]]
) -> Iterator[str]:
    """What differs in configuration, settings and axes, named as in specs."""
    for text in _differing(before[0], now[0], f"{kind}."):
        # it stands at the top
        yield text.removeprefix("evaluate.") if text.startswith("evaluate.episodes ") else text
    yield from _differing(before[1], now[1], "")
    old, new = (axes.get("method_config") or {} for *_, axes in (before, now))
    yield from _differing(old, new, f"{now[2].get('method')}.")


def _differing(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str) -> Iterator[str]:
    for name in dict.fromkeys((*now, *before)):
        old = before.get(name, _ABSENT)
        new = now.get(name, _ABSENT)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from _differing(old, new, f"{prefix}{name}.")
        elif old != new and not (
            isinstance(old, list | tuple)
            and isinstance(new, list | tuple)
            and list(old) == list(new)
        ):
            yield f"{prefix}{name} {_shown(old)} -> {_shown(new)}"


def _modules(now: Mapping[str, str], before: Mapping[str, str]) -> list[str]:
    changed = [name for name in now if before.get(name) != now[name]]
    return changed + [f"{name} (no longer used)" for name in before if name not in now]


def few(items: Sequence[str], most: int = NAMED) -> str:
    """Return the first items as a list in words, and how many more there are."""
    return ", ".join(items[:most]) + (f" and {len(items) - most} more" if len(items) > most else "")


def _shown(value: object) -> str:
    if value is _ABSENT:
        return "default"
    text = str(value)
    return text if len(text) <= 30 else text[:27] + "..."
