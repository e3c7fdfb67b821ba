"""A node as text: one section after the other."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from rich.text import Text

from wasp_cli.console import duration, size
from wasp_cli.report.node import NodeFacts, Setting
from wasp_cli.report.trained_table import scalars, short

HIDDEN = ("seconds", "started_at", "attempt", "versions", "git")
"""Provenance with lines of its own."""


def node_lines(node: NodeFacts) -> Iterator[Text]:
    """Set out a node; what is not known is left out."""
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
