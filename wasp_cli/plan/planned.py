"""The plan of a spec over a results folder and over what is published."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from wasp_cli.plan.grid import Grid
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.plan.selection import select
from wasp_cli.spec.load import Loaded
from wasp_cli.spec.sizes import told
from wasp_cli.store.layout import Layout


def laid_out(loaded: Loaded, layout: Layout, reuse: str | None) -> Grid:
    """Return the grid of a spec with published results in place of nodes; it notes which sizes a
    preset has replaced.
    """
    grid = lay_out_over(loaded.spec, layout, reuse)
    sections = {*(node.kind for node in grid.nodes), *loaded.spec.methods}
    note = told(loaded.spec, loaded.replaced, sections)
    return grid if note is None else replace(grid, notes=(note, *grid.notes))


def planned(
    loaded: Loaded,
    results: Path,
    chosen: Sequence[str] = (),
    reuse: str | None = None,
    *,
    failed: bool = False,
) -> Plan:
    """Return the plan that `run_spec` would carry out. The results folder need not exist."""
    layout = Layout(results.absolute())
    grid = laid_out(loaded, layout, reuse)
    return plan_against(grid, layout, wanted=select(grid, chosen), failed_only=failed)
