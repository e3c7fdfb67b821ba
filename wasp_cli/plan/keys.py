"""A node's key: a hash over everything that decides its bytes, and nothing else.

In it: what the node is, its resolved configuration, the keys of what it reads, the source of what it runs, and the major and minor versions
of the libraries that compute. Not in it: the name of the spec and of its severities, the order of lists, paths, workers, devices.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from math import isfinite
from typing import Any

SCHEMA = 1
"""Raised when the meaning of artifacts changes in a way that no other part of the key shows."""
LIBRARIES = ("mujoco", "numpy", "stable-baselines3", "torch")
LENGTH = 20


class Text(str):
    """Canonical JSON that was made before: a large grid has many nodes and few configurations."""

    __slots__ = ()


_NULL = Text("null")
_ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


@cache
def _word(text: str) -> Text:
    """A name or a word: they come again and again."""
    return Text(_ENCODER.encode(text))


def canonical(value: Any) -> Text:
    """Return JSON with sorted keys, without spaces and without non-numbers: the same text for the same content."""
    kind = type(value)
    if kind is Text:
        return value  # type: ignore[no-any-return]
    # The encoder takes several times as long to find out that there is nothing to descend into.
    if kind is str:
        return _word(value)
    if kind is int or (kind is float and isfinite(value)):
        return Text(repr(value))
    return _NULL if value is None else Text(_ENCODER.encode(value))


def joined(parts: Mapping[str, Any]) -> Text:
    """Return the canonical text of a mapping, some of whose values may be canonical texts already."""
    return Text("{" + ",".join([f"{_word(name)}:{canonical(parts[name])}" for name in sorted(parts)]) + "}")


def key_of(identity: Mapping[str, Any]) -> str:
    """Return the key of what `identity` describes; values that are `Text` stand for what they are the text of."""
    return hashlib.sha256(joined({**identity, "schema": Text(SCHEMA), "libraries": _libraries_text()}).encode()).hexdigest()[:LENGTH]


def recipe_of(identity: Mapping[str, Any]) -> str:
    """Return what `identity` describes, whatever code and libraries compute it; its upstream are the recipes of what it reads."""
    configuration = {name: value for name, value in identity.items() if name != "code"}
    return hashlib.sha256(joined({**configuration, "schema": Text(SCHEMA)}).encode()).hexdigest()[:LENGTH]


@cache
def libraries() -> dict[str, str]:
    """Return the major and minor version of each library whose numerics enter the results."""
    return {name: ".".join(_version(name).split(".")[:2]) for name in LIBRARIES}


@cache
def _libraries_text() -> Text:
    return canonical(libraries())


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"
