"""What the manifest of a node says, and the same as text: what it is, where it came from, its inputs, whether its files are undamaged."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from rich.text import Text

from wasp_cli.config import Config
from wasp_cli.console import size
from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.grid import stage_class
from wasp_cli.report.trained.artifacts import duration, scalars, short
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.artifact import damage, is_file_name, read_manifest
from wasp_cli.store.find import FoundNode
from wasp_cli.store.layout import Layout, is_key, is_name
from wasp_cli.store.plain import open_plain, printable
from wasp_cli.store.published import FROM_PUBLISHED

HIDDEN = ("seconds", "started_at", "attempt", "versions", "git")
"""Provenance that is told in lines of its own."""

FileState = Literal["whole", "changed", "gone", "not of the artifact"]


@dataclass(frozen=True)
class Setting:
    """A value that is not the default."""

    name: str
    value: Any
    default: Any = None
    """None where this version has no default for it."""


@dataclass(frozen=True)
class Upstream:
    """An input of the node."""

    name: str
    """The name under which the node reads it."""
    kind: str
    key: str
    label: str
    state: Literal["present", "damaged", "gone", "not brought in"]
    """The last: the node was published, and nothing here needed what it was computed from."""


@dataclass(frozen=True)
class StoredFile:
    """A file of the artifact."""

    name: str
    size: int | None
    state: FileState
    """Whether it still has the SHA-256 that it was published with."""


@dataclass(frozen=True)
class NodeFacts:
    """What is known of a node; of one that has only failed, its label, kind and failure."""

    key: str
    kind: str
    label: str
    folder: str
    started_at: str
    seconds: float | None
    attempt: int | None
    summary: Mapping[str, Any] = field(default_factory=dict)
    changed: tuple[Setting, ...] = ()
    """The configuration, as far as it is not the default."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings that stages share."""
    upstream: tuple[Upstream, ...] = ()
    files: tuple[StoredFile, ...] = ()
    pictures: tuple[str, ...] = ()
    """Folders of reports with pictures and pages of it (see `trained.evidence`)."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    failure: Mapping[str, Any] = field(default_factory=dict)
    """Why it failed last; empty when it succeeded since."""


def node_facts(layout: Layout, node: FoundNode) -> NodeFacts:
    """Collect what the manifest of a node says; its files are read and their SHA-256 compared."""
    provenance = mapping(node.setting("provenance"))
    seconds, attempt = provenance.get("seconds"), provenance.get("attempt", node.failure.get("attempt"))
    return NodeFacts(
        key=node.key or "",
        kind=node.kind,
        label=node.label or "",
        folder=str(node.path),
        started_at=node.started_at,
        seconds=float(seconds) if isinstance(seconds, int | float) else None,
        attempt=attempt if isinstance(attempt, int) else None,
        summary=mapping(node.setting("summary")),
        changed=tuple(_changed(node)),
        settings=mapping(node.setting("settings")),
        upstream=tuple(_upstream(layout, node)),
        files=tuple(_files(layout, node)),
        pictures=tuple(_pictures(layout, node)),
        provenance=provenance,
        failure=node.failure,
    )


def _changed(node: FoundNode) -> Iterator[Setting]:
    """What of the stage's section and of the method's differs from the defaults; all of it, where this version has no such stage."""
    section = stage_class(node.kind).config if node.kind in STAGES else None
    yield from _differences("", mapping(node.setting("config")), _defaults(section))
    method = node.setting("axes", "method")
    if isinstance(method, str):
        section = METHODS[method].config_model() if method in METHODS else None
        yield from _differences(f"{method}.", mapping(node.setting("axes", "method_config")), _defaults(section))


def _defaults(section: type[Config] | None) -> dict[str, Any]:
    return {} if section is None else section().model_dump(mode="json")


def _differences(prefix: str, values: Mapping[str, Any], defaults: Mapping[str, Any]) -> Iterator[Setting]:
    for name, value in values.items():
        default = defaults.get(name)
        if isinstance(value, dict) and isinstance(default, dict):
            yield from _differences(f"{prefix}{name}.", value, default)
        elif name not in defaults or value != default:
            yield Setting(f"{prefix}{name}", value, default)


def _upstream(layout: Layout, node: FoundNode) -> Iterator[Upstream]:
    kinds = mapping(node.setting("upstream_kinds"))
    for name, key in mapping(node.setting("upstream")).items():
        kind = kinds.get(name, name)  # older manifests name artifacts by kind
        if not (isinstance(key, str) and is_key(key) and isinstance(kind, str) and is_name(kind)):
            continue
        try:
            label = str(read_manifest(layout, kind, key).get("label", ""))
        except ArtifactError:
            there = layout.artifact(kind, key).exists()
            absent: Literal["gone", "not brought in"] = "not brought in" if node.setting("provenance", FROM_PUBLISHED) else "gone"
            yield Upstream(name, kind, key, "", "damaged" if there else absent)
        else:
            yield Upstream(name, kind, key, label, "present" if damage(layout, kind, key) is None else "damaged")


def _files(layout: Layout, node: FoundNode) -> Iterator[StoredFile]:
    for name, known in mapping(node.setting("files")).items():
        known = mapping(known)
        size = known.get("size")
        yield StoredFile(name, size if isinstance(size, int) else None, _file_state(layout, node, name, known))


def _pictures(layout: Layout, node: FoundNode) -> Iterator[str]:
    if node.key is not None and is_key(node.key):
        yield from sorted(printable(str(path)) for path in (layout.root / "reports").glob(f"*/trained/*-{node.key[:8]}"))


def _file_state(layout: Layout, node: FoundNode, name: str, known: Mapping[str, Any]) -> FileState:
    if not is_file_name(name):
        return "not of the artifact"
    try:
        with open_plain(layout.within(node.path / name)) as file:
            return "whole" if hashlib.file_digest(file, "sha256").hexdigest() == known.get("sha256") else "changed"
    except FileNotFoundError:
        return "gone"
    except (OSError, StoreError):  # a link, a pipe, a folder
        return "changed"


def mapping(value: Any) -> Mapping[str, Any]:
    """Return a value of a manifest if it is a mapping, else an empty one."""
    return value if isinstance(value, dict) else {}


def node_lines(node: NodeFacts) -> Iterator[Text]:
    """Yield the lines of a node, one section after the other; what is not known is left out."""
    yield Text(node.label, style="bold")
    yield _entry("kind", node.kind)
    yield _entry("key", node.key)
    if node.started_at:
        took = f" in {duration(node.seconds)}" if node.seconds is not None else ""
        yield _entry("computed", f"{node.started_at[:16].replace('T', ' ')} UTC{took}")
    if node.attempt is not None:
        yield _entry("attempt", str(node.attempt))
    yield _entry("folder", node.folder)
    yield from _failure(node.failure)
    yield from _section("Numbers", [(name, short(value)) for name, value in scalars(node.summary)])
    changes = [(each.name, _change(each)) for each in node.changed]
    yield from _section("Configuration (without defaults)", changes)
    yield from _section("Shared settings", [(name, short(value)) for name, value in scalars(node.settings)])
    yield from _section(
        "Inputs", [(each.name, f"{each.key[:8]}  {each.label}  {_unless('present', each.state)}") for each in node.upstream]
    )
    files = [(each.name, f"{size(each.size)}  {_unless('whole', each.state)}") for each in node.files]
    yield from _section("Files (SHA-256 checked)", files)
    yield from _section("Drawn by wasp report", [("in", folder) for folder in node.pictures])
    yield from _section("Provenance", list(_provenance(node.provenance)))


def _change(setting: Setting) -> str:
    default = f"  (default {_value(setting.default)})" if setting.default is not None else ""
    return _value(setting.value) + default


def _failure(failure: Mapping[str, Any]) -> Iterator[Text]:
    if not failure:
        return
    yield Text()
    yield Text("Last failure", style="bold red")
    for name in ("message", "hint", "log", "run", "attempt"):
        if failure.get(name) is not None:
            yield _entry(name, str(failure[name]))


def _provenance(provenance: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    git = provenance.get("git")
    if isinstance(git, dict):
        state = f"with uncommitted changes ({git.get('changes') or 'outside of the package'})" if git.get("dirty") else "as committed"
        yield "git", f"{git.get('sha')}, {state}"
    for name, value in provenance.items():
        if name not in HIDDEN:
            yield name, value if isinstance(value, str) else _value(value)
    versions = provenance.get("versions")
    if isinstance(versions, dict):
        yield "versions", ", ".join(f"{name} {version}" for name, version in versions.items() if version)


def _section(heading: str, entries: list[tuple[str, str]]) -> Iterator[Text]:
    if entries:
        yield Text()
        yield Text(heading, style="bold")
        width = max(len(name) for name, _ in entries)
        yield from (_entry(name, text, width) for name, text in entries)


def _entry(name: str, text: str, width: int = 8) -> Text:
    return Text(f"  {name:<{width}}  {text}".rstrip())


def _value(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _unless(expected: str, state: str) -> str:
    return "" if state == expected else state.upper()
