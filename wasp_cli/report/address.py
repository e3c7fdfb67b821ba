"""The address of every place in `wasp view`, and the command that opens it: what `explain`, `replay` and the report print."""

from __future__ import annotations

import shlex
from pathlib import Path
from urllib.parse import quote

READABLE = "/ =+"  # characters that stand in an address as they are; a browser is given %20 for a space


def cell_address(cell: str, episode: int | None = None, step: int | None = None) -> str:
    """Return where a cell, an episode of it or a decision stands: `/cell/goal1 s1 wasp laggy=0.7/episode/3?step=100`.

    Args:
        cell: its label, or the beginning of its key.
        episode: which of its episodes; None: the cell.
        step: which decision; None: the first.
    """
    place = f"/cell/{quote(cell, READABLE)}"
    place += "" if episode is None else f"/episode/{episode}"
    return place if step is None else f"{place}?step={step}"


def open_command(results: Path | str, address: str) -> str:
    """Return the command that opens a place."""
    return f"wasp view {shlex.quote(str(results))} --open {shlex.quote(address)}"
