"""What loops of others hand over, as it may come: NumPy's numbers count as Python's, and what is no
seed or no number of anything is refused with what to pass.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from wasp_cli.errors import UsageError

SEEDS = 2**128
"""Seeds are below: the streams of operators and assistants take no larger ones."""


def whole_number(given: Any) -> int | None:
    """Return a whole number of Python's or NumPy's, also in an array without dimensions; None of
    anything else, a bool included.
    """
    if isinstance(given, np.ndarray) and given.ndim == 0:
        given = given[()]
    if isinstance(given, bool) or not isinstance(given, int | np.integer):
        return None
    return int(given)


def one_seed(given: Any, name: str = "seed") -> int:
    """Return a seed; `name` is what the caller calls it.

    Raises:
        UsageError: it is none.
    """
    seed = whole_number(given)
    if seed is None or not 0 <= seed < SEEDS:
        raise UsageError(f"{name}={given!r} is no seed", "a seed is a whole number, at least 0")
    return seed


def seeds_of(given: Any, rows: int) -> list[int]:
    """Return a seed for each of so many episodes; of a single one it may stand alone.

    Raises:
        UsageError: they are no seeds, or another number of them.
    """
    alone = whole_number(given) is not None or isinstance(given, str)
    try:
        listed = [given] if alone else list(given)
    except TypeError:
        listed = [given]
    if len(listed) != rows:
        raise UsageError(f"{len(listed)} seeds for {rows} episodes", "one for each episode")
    return [one_seed(each) for each in listed]


def number_of(given: Any, name: str, things: str, otherwise: str = "") -> int:
    """Return a number of at least 1.

    Args:
        given: what was passed.
        name: what the caller calls it.
        things: what is counted.
        otherwise: what else may be passed, for the hint.

    Raises:
        UsageError: it is none.
    """
    number = whole_number(given)
    if number is None or number < 1:
        raise UsageError(
            f"{name}={given!r} is no number of {things}", f"it is at least 1{otherwise}"
        )
    return number
