"""Cells whose severity was left open (`auto`), with the number that was chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from wasp_cli.errors import ArtifactError
from wasp_cli.metrics.severity import AUTO
from wasp_cli.plan.node import Cell
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.severities import severity_of

Keyed = Sequence[tuple[Cell, str]]  # cells with the keys of their artifacts


def with_severities(
    layout: Layout, cells: Keyed, branched: Keyed = ()
) -> tuple[list[tuple[Cell, str]], list[tuple[Cell, str]]]:
    """Return cells, and cells with the keys of their branches, with the severity that their rows
    have in the place of `auto`. One that is not computed keeps `auto`.
    """
    numbered = {cell: _numbered(layout, cell, key) for cell, key in cells if cell.value == AUTO}
    return (
        [(numbered.get(cell, cell), key) for cell, key in cells],
        [(numbered.get(cell, cell), key) for cell, key in branched],
    )


def _numbered(layout: Layout, cell: Cell, key: str) -> Cell:
    if not is_key(key) or not layout.manifest(KIND, key).is_file():
        return cell
    try:
        return replace(cell, value=severity_of(read_manifest(layout, KIND, key)))
    except (ArtifactError, LookupError, TypeError, ValueError):
        return cell  # damaged, as the report says where it reads the rows
