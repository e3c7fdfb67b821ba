"""The clone of a person that a running node reads. The stage places it here, where operators find
it; the node's key covers the clone.
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
    """A clone, and the recorded commands of the person where a session is replayed."""

    folder: Path  # the artifact of the stage `clone`
    said: Mapping[int, NDArray[np.float32]] = field(default_factory=dict)
    """The recorded commands [T, A] by the seed of the operator's episode; empty where no session is
    replayed.
    """


_PLACED: ContextVar[PlacedClone | None] = ContextVar("clone", default=None)


@contextmanager
def placed(clone: PlacedClone | None) -> Iterator[None]:
    """Let operators that are built inside the block find a clone; None changes nothing."""
    before = _PLACED.set(clone or _PLACED.get())
    try:
        yield
    finally:
        _PLACED.reset(before)


def placed_clone() -> PlacedClone | None:
    """Return the clone that is placed; None where there is none."""
    return _PLACED.get()


def required_clone() -> PlacedClone:
    """Return the clone that is placed.

    Raises:
        UsageError: there is none.
    """
    clone = _PLACED.get()
    if clone is None:
        raise UsageError(
            "the clone of a person drives evaluations and their branches alone",
            "name other operators here",
        )
    return clone
