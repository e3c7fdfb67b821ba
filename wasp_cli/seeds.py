"""Random streams named by role: the same identity gives the same seed on every machine, in every
order of work.

The name of the method enters `method_seed` alone, so that all methods face the same worlds and the
same mistakes of the operator, and differences between them can be tested in pairs. The severity
enters none: the severities of an operator share their draws, so that where the rule compares a draw
with the severity (`noisy`, `laggy`), a severer operator makes every mistake of a milder one, and
more.
"""

from __future__ import annotations

import hashlib
import json
import operator
from typing import SupportsIndex

Part = str | float | SupportsIndex | None


def derive(*parts: Part) -> int:
    """Derive a seed in [0, 2**31) from the parts. Types count: 1, 1.0 and "1" are different
    parts; any integer type is an `int`.
    """
    canonical = json.dumps(
        [_plain(part) for part in parts], ensure_ascii=True, separators=(",", ":"), allow_nan=False
    )
    return int.from_bytes(hashlib.sha256(canonical.encode()).digest()[:4], "big") & 0x7FFFFFFF


def layout_seed(task: str, seed: int, episode: int) -> int:
    """Derive the seed of the world of one evaluation episode."""
    return derive("layout", task, seed, episode)


def operator_seed(task: str, operator: str, seed: int, episode: int) -> int:
    """Derive the seed of the operator's mistakes in one evaluation episode, the same at every
    severity.
    """
    return derive("operator", task, operator, seed, episode)


def method_seed(task: str, operator: str, seed: int, episode: int, method: str) -> int:
    """Derive the seed of an assistant's own sampling in one evaluation episode.

    The same at every severity: until the commands differ, the assistant decides the same.
    """
    return derive("method", task, operator, seed, episode, method)


def _plain(part: Part) -> str | float | int | None:
    if part is None or isinstance(part, str):
        return part
    if isinstance(part, float):
        return float(part)  # numpy's float64 is a float; its repr is not
    return operator.index(part)
