"""What it takes to run the episodes of a stored cell again: worlds, commands and executed actions,
and the rewards that show whether they are the same.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wasp_cli.errors import StoreError
from wasp_cli.store.parquet import AGAIN
from wasp_cli.store.tables import read_episodes, read_steps


def read_recorded(path: Path) -> dict[str, Any]:
    """Read the fields of `learning.rerun.Recorded` by name; see there. Commands and actions are
    float32, exactly as they were executed.

    Raises:
        StoreError: a file cannot be read, or does not hold whole episodes in their order.
    """
    episodes = read_episodes([path])
    steps = read_steps(path)
    numbers = np.asarray(episodes["episode"])
    lengths = np.asarray(episodes["decisions"])
    step_numbers = np.asarray(steps["episode"])
    are_ordered = (numbers == np.arange(len(numbers))).all()
    are_whole = np.array_equal(step_numbers, np.repeat(numbers, lengths))
    if not len(numbers) or not are_ordered or not are_whole or (lengths < 1).any():
        raise StoreError(f"{path} does not hold whole episodes, one after the other", AGAIN)
    ends = np.cumsum(lengths)[:-1]
    parts = {
        "a_h": _actions(path, steps, "a_h"),
        "a": _actions(path, steps, "a"),
        "reward": np.asarray(steps["reward"], np.float32),
    }
    return {
        "layouts": episodes["episode_seed"].to_pylist(),
        **{name: np.split(values, ends) for name, values in parts.items()},
    }


def _actions(path: Path, steps: pa.Table, name: str) -> NDArray[np.float32]:
    """A column of actions as float32 [T, A]."""
    nested = steps[name].combine_chunks()
    sizes = np.unique(np.asarray(nested.value_lengths().fill_null(0)))
    if len(sizes) != 1 or not sizes[0]:
        raise StoreError(f"{path}: '{name}' is missing, or has another size in every step", AGAIN)
    return np.asarray(nested.flatten(), np.float32).reshape(-1, int(sizes[0]))
