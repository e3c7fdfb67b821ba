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
    """JSON with sorted keys, without spaces and without non-numbers: the same text for the same content."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


def key_of(identity: Mapping[str, Any]) -> str:
    """The key of what `identity` describes."""
    return hashlib.sha256(canonical({**identity, "schema": SCHEMA, "libraries": libraries()}).encode()).hexdigest()[:LENGTH]


@cache
def libraries() -> dict[str, str]:
    """Major and minor version of each library whose numerics enter the results."""
    return {name: ".".join(_version(name).split(".")[:2]) for name in LIBRARIES}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"
