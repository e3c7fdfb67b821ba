"""Keys: a hash over everything that decides a node's bytes, and nothing else.

A key contains what the node is, its resolved configuration, the keys of its inputs, the source of
the code that it runs (`plan.source`), and the major and minor versions of the libraries that
compute. It does not contain the names of the spec and of its severities, the order of lists, paths,
workers and devices.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

# raised when the meaning of artifacts changes in a way that no other part of the key shows
SCHEMA = 1
LIBRARIES = ("mujoco", "numpy", "stable-baselines3", "torch")
LENGTH = 20  # hexadecimal digits of a key


def canonical(value: Any) -> str:
    """Return a value as JSON text, the same whatever the order of its mappings.

    Raises:
        ValueError: it has NaN or infinity, which JSON does not have.
        TypeError: it has something that is no JSON value.
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any, length: int = LENGTH) -> str:
    """Return the first `length` hexadecimal digits of the SHA-256 of a JSON value.

    Raises:
        ValueError, TypeError: as `canonical`.
    """
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:length]


def key_of(identity: Mapping[str, Any]) -> str:
    """Return the key of a node: two nodes with the same key have the same bytes.

    Args:
        identity: what the node is, as JSON values: its kind and place, its configuration, the keys
            of what it reads, and the hash of its source. `plan.grid` puts it together.

    Returns:
        20 hexadecimal digits, which also cover the version of our artifacts and the minor versions
        of the libraries that compute.

    Raises:
        ValueError: a number of the identity is NaN or infinite.
        TypeError: a part of it is no JSON value.
    """
    return digest({**identity, "schema": SCHEMA, "libraries": libraries()})


def recipe_of(identity: Mapping[str, Any]) -> str:
    """Return a hash of what `identity` describes, without code and libraries. Its upstream are the
    recipes of its inputs.

    Raises:
        ValueError: as `key_of`.
        TypeError: as `key_of`.
    """
    return digest({**identity, "schema": SCHEMA})


@cache
def libraries() -> dict[str, str]:
    """Return major and minor version of each library that computes; `absent` if it is not
    installed.
    """
    return {name: minor(_installed(name)) for name in LIBRARIES}


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def minor(version: object) -> str:
    """Return major and minor of a version, such as `2.8` of `2.8.1`; `absent` for anything but a
    text.
    """
    return ".".join(version.split(".")[:2]) if isinstance(version, str) else "absent"
