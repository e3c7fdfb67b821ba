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
from typing import Any

SCHEMA = 1
"""Raised when the meaning of artifacts changes in a way that no other part of the key shows."""
LIBRARIES = ("mujoco", "numpy", "stable-baselines3", "torch")
LENGTH = 20


def canonical(value: Any) -> str:
    """Return JSON with sorted keys, without spaces and without non-numbers: the same text for the same content."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any, length: int = LENGTH) -> str:
    """Return the first hexadecimal digits of a hash over some content."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:length]


def key_of(identity: Mapping[str, Any]) -> str:
    """Return the key of what `identity` describes."""
    return digest({**identity, "schema": SCHEMA, "libraries": libraries()})


def recipe_of(identity: Mapping[str, Any]) -> str:
    """Return what `identity` describes, whatever code and libraries compute it; its upstream are the recipes of what it reads."""
    return digest({**{name: value for name, value in identity.items() if name != "code"}, "schema": SCHEMA})


@cache
def libraries() -> dict[str, str]:
    """Return the major and minor version of each library whose numerics enter the results."""
    return {name: minor(_installed(name)) for name in LIBRARIES}


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def minor(version: object) -> str:
    """Return the major and the minor part of a version; `absent` where there is none."""
    return ".".join(version.split(".")[:2]) if isinstance(version, str) else "absent"
