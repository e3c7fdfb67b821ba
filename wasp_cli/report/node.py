"""What is known about a node, as facts and as lines of text: what it is, where it came from, its
inputs, and whether its files are undamaged.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

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

# entries of the provenance that have lines of their own
HIDDEN = ("seconds", "started_at", "attempt", "versions", "git")

Facts = dict[str, Any]  # as `wasp show --json` prints them


def node_facts(layout: Layout, node: FoundNode) -> Facts:
    """Collect what is known about a node. A node that has only failed has a label, kind and
    failure.

    All its files are read: `state` says whether each still has the SHA-256 of its manifest
    (`whole`), or is `changed` or `gone`. An input is `present`, `damaged`, `gone`, or `not brought
    in`, which is an input of a published node that nothing here needed. `changed` lists the
    configuration that differs from the defaults; a default is None if this version has none.
    `pictures` are the folders of reports that hold pictures of the node (`trained.evidence`).
    """
    provenance = mapping(node.setting("provenance"))
    seconds = provenance.get("seconds")
    attempt = provenance.get("attempt", node.failure.get("attempt"))
    pictures: list[str] = []
    if node.key is not None and is_key(node.key):
        folders = layout.root.glob(f"reports/*/trained/*-{node.key[:8]}")
        pictures = sorted(printable(str(folder)) for folder in folders)
    return {
        "key": node.key or "",
        "kind": node.kind,
        "label": node.label or "",
        "folder": str(node.path),
        "started_at": node.started_at,
        "seconds": float(seconds) if isinstance(seconds, int | float) else None,
        "attempt": attempt if isinstance(attempt, int) else None,
        "summary": mapping(node.setting("summary")),
        "changed": list(_changed(node)),
        "settings": mapping(node.setting("settings")),
        "upstream": list(_upstream(layout, node)),
        "files": list(_files(layout, node)),
        "pictures": pictures,
        "provenance": provenance,
        "failure": node.failure,
    }


def _changed(node: FoundNode) -> Iterator[Facts]:
    section = stage_class(node.kind).config if node.kind in STAGES else None
    yield from _differences("", mapping(node.setting("config")), _defaults(section))
    method = node.setting("axes", "method")
    if isinstance(method, str):
        section = METHODS[method].config_model() if method in METHODS else None
        yield from _differences(
            f"{method}.", mapping(node.setting("axes", "method_config")), _defaults(section)
        )


def _defaults(section: type[Config] | None) -> dict[str, Any]:
    return {} if section is None else section().model_dump(mode="json")


def _differences(
    prefix: str, values: Mapping[str, Any], defaults: Mapping[str, Any]
) -> Iterator[Facts]:
    for name, value in values.items():
        default = defaults.get(name)
        if isinstance(value, dict) and isinstance(default, dict):
            yield from _differences(f"{prefix}{name}.", value, default)
        elif name not in defaults or value != default:
            yield {"name": f"{prefix}{name}", "value": value, "default": default}


def _upstream(layout: Layout, node: FoundNode) -> Iterator[Facts]:
    for name, (kind, key) in upstream_of(node.manifest).items():
        try:
            label = str(read_manifest(layout, kind, key).get("label", ""))
            state = "present" if damage(layout, kind, key) is None else "damaged"
        except ArtifactError:
            label = ""
            if layout.artifact(kind, key).exists():
                state = "damaged"
            elif node.setting("provenance", FROM_PUBLISHED):
                state = "not brought in"
            else:
                state = "gone"
        yield {"name": name, "kind": kind, "key": key, "label": label, "state": state}


def _files(layout: Layout, node: FoundNode) -> Iterator[Facts]:
    for name, known in mapping(node.setting("files")).items():
        size = mapping(known).get("size")
        state = _file_state(layout, node, name, mapping(known).get("sha256"))
        yield {"name": name, "size": size if isinstance(size, int) else None, "state": state}


def _file_state(layout: Layout, node: FoundNode, name: str, digest: Any) -> str:
    if not is_file_name(name):
        return "not of the artifact"
    try:
        with open_plain(layout.within(node.path / name)) as file:
            actual = hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        return "gone"
    except (OSError, StoreError):  # a link, a pipe, a folder
        return "changed"
    return "whole" if actual == digest else "changed"


def mapping(value: Any) -> Mapping[str, Any]:
    """Return a value that is a mapping; an empty one instead of anything else, since a manifest may
    be untrusted.
    """
    return value if isinstance(value, dict) else {}


def upstream_of(manifest: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return the inputs of an artifact: kind and key by the name under which each was read. Entries
    of another form are left out.
    """
    kinds = mapping(manifest.get("upstream_kinds"))
    read = {
        name: (kinds.get(name, ""), key) for name, key in mapping(manifest.get("upstream")).items()
    }
    return {
        name: one
        for name, one in read.items()
        if all(isinstance(text, str) for text in one) and is_name(one[0]) and is_key(one[1])
    }


def node_lines(facts: Facts) -> Iterator[Text]:
    """Yield `node_facts` as lines for a terminal: identity, last failure, numbers, configuration,
    inputs, files and provenance. Sections without entries are left out.
    """
    yield Text(facts["label"], style="bold")
    yield _entry("kind", facts["kind"])
    yield _entry("key", facts["key"])
    if facts["started_at"]:
        took = f" in {duration(facts['seconds'])}" if facts["seconds"] is not None else ""
        yield _entry("computed", f"{facts['started_at'][:16].replace('T', ' ')} UTC{took}")
    if facts["attempt"] is not None:
        yield _entry("attempt", str(facts["attempt"]))
    yield _entry("folder", facts["folder"])
    yield from _failure(facts["failure"])
    yield from _section(
        "Numbers", [(name, short(value)) for name, value in scalars(facts["summary"])]
    )
    changed = []
    for one in facts["changed"]:
        text = _value(one["value"])
        if one["default"] is not None:
            text += f"  (default {_value(one['default'])})"
        changed.append((one["name"], text))
    yield from _section("Configuration (without defaults)", changed)
    yield from _section(
        "Shared settings", [(name, short(value)) for name, value in scalars(facts["settings"])]
    )
    inputs = [
        (one["name"], f"{one['key'][:8]}  {one['label']}  {_unless('present', one['state'])}")
        for one in facts["upstream"]
    ]
    yield from _section("Inputs", inputs)
    files = [
        (one["name"], f"{size(one['size'])}  {_unless('whole', one['state'])}")
        for one in facts["files"]
    ]
    yield from _section("Files (SHA-256 checked)", files)
    yield from _section("Drawn by wasp report", [("in", folder) for folder in facts["pictures"]])
    yield from _section("Provenance", list(_provenance(facts["provenance"])))


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
        state = "as committed"
        if git.get("dirty"):
            state = f"with uncommitted changes ({git.get('changes') or 'outside of the package'})"
        yield "git", f"{git.get('sha')}, {state}"
    for name, value in provenance.items():
        if name not in HIDDEN:
            yield name, value if isinstance(value, str) else _value(value)
    versions = provenance.get("versions")
    if isinstance(versions, dict):
        yield (
            "versions",
            ", ".join(f"{name} {version}" for name, version in versions.items() if version),
        )


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
