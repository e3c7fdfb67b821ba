"""Where the clone of a person lies while a node runs: what runs it says so, and the key covers
the clone, since the node reads it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import UsageError


@dataclass(frozen=True)
class PlacedClone:
    """A clone, and what the person really commanded where that is played again."""

    folder: Path  # the artifact of the stage `clone`
    said: Mapping[int, NDArray[np.float32]] = field(default_factory=dict)
    """[T, A] commands by the seed of the operator's episode; empty where nobody is played again"""


_PLACED: ContextVar[PlacedClone | None] = ContextVar("clone", default=None)


@contextmanager
def placed(clone: PlacedClone | None) -> Iterator[None]:
    """Let operators inside the block find a clone; None changes nothing."""
    before = _PLACED.set(clone or _PLACED.get())
    try:
        yield
    finally:
        _PLACED.reset(before)


def placed_clone() -> PlacedClone | None:
    """Return the clone of the block that runs; None outside."""
    return _PLACED.get()


def required_clone() -> PlacedClone:
    """Return the clone of the block that runs."""
    found = _PLACED.get()
    if found is None:
        raise UsageError(
            "the clone of a person drives evaluations and their branches alone",
            "name other operators here",
        )
    return found
