"""How a stored node falls short, from its manifest and those of its inputs. Manifests may be
untrusted: numbers of another form are not judged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.errors import ArtifactError
from wasp_cli.plan.bars import BARS, Measured, Shortfall, shortfalls
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.plain import printable


def judged(layout: Layout, kind: str, key: str) -> list[Shortfall]:
    """Return how a stored node falls short, by the kind of its stage and its key; empty if there is
    no such node, or its stage has no bars.
    """
    if kind not in BARS:
        return []
    manifest = _manifest(layout, kind, key)
    summary = _mapping(manifest.get("summary"))
    config = _mapping(manifest.get("config"))
    kinds = _mapping(manifest.get("upstream_kinds"))
    behind: dict[str, Mapping[str, Any]] = {}
    for name, needed in _mapping(manifest.get("upstream")).items():
        of_kind = kinds.get(name)
        if isinstance(of_kind, str) and of_kind in BARS:
            behind[of_kind] = _mapping(_manifest(layout, of_kind, needed).get("summary"))
    return [
        Shortfall(printable(found.sentence), found.remedy)
        for found in shortfalls(kind, Measured(summary, config, behind))
    ]


def _manifest(layout: Layout, kind: str, key: object) -> Mapping[str, Any]:
    if not (isinstance(key, str) and is_key(key)):
        return {}
    try:
        return _mapping(read_manifest(layout, kind, key))
    except ArtifactError:
        return {}


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
