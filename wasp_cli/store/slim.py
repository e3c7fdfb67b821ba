"""Smaller copies of artifacts for publishing: of a cell only the steps of its first episodes, of
diagnostics no images.

The manifest has under `slim`, by file, what was left out and the SHA-256 of the whole file. Rows of
episodes are never left out, so that tables are the same. Nothing is computed from the steps of a
slim cell: it is computed again instead.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from wasp_cli.errors import ArtifactError
from wasp_cli.store.artifact import file_digest

STEPS_FILE = "_steps.pq"  # as in `store.tables`, which needs pyarrow
# in a published manifest: by file, what was left out of it, and the digest of the whole
SLIM = "slim"
WITHOUT_STEPS = "it was published without the steps of all its episodes, and they are needed"
# of `diagnostics`: frames for pictures in reports; nothing is computed from them
IMAGES_FILE = "images.parquet"


class Slimming(NamedTuple):
    """What stays in a copy."""

    steps: int | None = None  # episodes of a cell whose steps stay; None for all
    images: bool = True  # whether the images of diagnostics stay


def slim(folder: Path, kind: str, wanted: Slimming) -> dict[str, dict[str, Any]]:
    """Rewrite the files of a copied artifact smaller.

    Returns:
        By name of each file that changed: `left_out`, and `sha256` of the whole file.
    """
    changed: dict[str, dict[str, Any]] = {}
    for path in sorted(folder.rglob("*")):
        whole = file_digest(path) if path.is_file() else ""
        is_steps = kind == "evaluate" and path.name == STEPS_FILE
        is_images = kind == "diagnostics" and path.name == IMAGES_FILE
        if is_steps and wanted.steps is not None and _cut(path, wanted.steps):
            left_out = _steps_left_out(wanted.steps)
        elif is_images and not wanted.images:
            path.unlink()
            left_out = "images"
        else:
            continue
        changed[path.relative_to(folder).as_posix()] = {"left_out": left_out, "sha256": whole}
    return changed


def _steps_left_out(steps: int) -> str:
    """What is left out where the steps of so many episodes stay; `steps_kept` reads it."""
    if steps == 0:
        return "all steps"
    if steps == 1:
        return "steps of all episodes but the first"
    return f"steps of all episodes but the first {steps}"


def without_steps(manifest: Mapping[str, Any]) -> bool:
    """Return whether steps of a published cell were left out, so that nothing may be computed
    from it.
    """
    changed = manifest.get(SLIM)
    return manifest.get("kind") == "evaluate" and isinstance(changed, Mapping) and bool(changed)


def steps_kept(manifest: Mapping[str, Any]) -> float:
    """Return of how many episodes a published cell has the steps, from what its manifest says was
    left out; infinity for all.
    """
    if not without_steps(manifest):
        return math.inf
    first = re.search(r"but the first(?: (\d{1,9}))?", str(manifest[SLIM]))
    return int(first[1] or 1) if first else 0


def first_episodes(folder: Path, episodes: int) -> dict[str, float]:
    """Keep the rows of the first episodes of a copied cell, and their steps; return its summary, as
    `stages.evaluate` writes it. Raises ArtifactError where it does not have so many episodes.
    """
    import numpy as np
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    from wasp_cli.store.tables import EPISODES_FILE, write_episodes

    table = pq.read_table(folder / EPISODES_FILE)
    rows = table.filter(pc.less(table["episode"], episodes)).combine_chunks()
    if rows["episode"].to_pylist() != list(range(episodes)):
        raise ArtifactError(
            f"'{folder / EPISODES_FILE}' does not have the first {episodes} episodes",
            "run with --reuse none",
        )
    write_episodes(rows, folder / EPISODES_FILE)
    _cut(folder / STEPS_FILE, episodes)
    return {
        "return": round(float(np.mean(rows["return"])), 2),
        "cost": round(float(np.mean(rows["cost"])), 1),
        "int": round(float(np.mean(rows["int_rate"])), 3),
    }


def _cut(path: Path, episodes: int) -> bool:
    """Keep the steps of the first `episodes`; return whether there were others."""
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    from wasp_cli.store.parquet import write_table

    table = pq.read_table(path)
    rows = table.filter(pc.less(table["episode"], episodes))
    if len(rows) == len(table):
        return False
    write_table(rows, path)
    return True
