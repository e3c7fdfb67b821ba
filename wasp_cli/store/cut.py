"""A cell with fewer episodes, cut from a whole one: its rows are the first rows there, and nothing is computed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wasp_cli.errors import ArtifactError

CUT_FROM = "cut_from"
"""In the provenance of a cell: the key of the whole cell whose first episodes it has. Its `seconds` are their share of that cell's time."""


def cut_cell(folder: Path, episodes: int) -> Mapping[str, Any]:
    """Keep the rows of the first episodes of a copied cell, and of its steps those that are there.

    Args:
        folder: the copy; its files are replaced.
        episodes: that stay.

    Returns:
        The summary of the cell, as `stages.evaluate` gives it.

    Raises:
        ArtifactError: the cell does not have these episodes.
        StoreError: a file is damaged, or cannot be written.
    """
    import numpy as np
    import pyarrow.compute as pc

    from wasp_cli.store.parquet import opened_table, write_table
    from wasp_cli.store.tables import EPISODES_FILE, STEPS_FILE, STEPS_KEY, VERSION, VERSION_KEY, write_episodes

    with opened_table(folder / EPISODES_FILE, VERSION_KEY, VERSION, "the table of a cell") as file:
        table = file.read(use_threads=False)
        kept = table.filter(pc.less(table["episode"], episodes)).combine_chunks()
        if kept["episode"].to_pylist() != list(range(episodes)):
            raise ArtifactError(f"'{folder / EPISODES_FILE}' does not have the first {episodes} episodes", "run with --reuse none")
        means = {name: float(np.mean(kept[name])) for name in ("return", "cost", "int_rate")}
    with opened_table(folder / STEPS_FILE, STEPS_KEY, VERSION, "the steps of a cell") as file:
        table = file.read(use_threads=False)
        steps = table.filter(pc.less(table["episode"], episodes)).combine_chunks()
    write_table(steps, folder / STEPS_FILE)
    write_episodes(kept, folder / EPISODES_FILE)
    return {"return": round(means["return"], 2), "cost": round(means["cost"], 1), "int": round(means["int_rate"], 3)}
