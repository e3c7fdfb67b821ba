"""Which runs of a results folder a command is about."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from wasp_cli.errors import StoreError, UnknownName
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from wasp_cli.cells.runs import LastRuns


def reported_runs(results: Path, spec: str | None) -> tuple[Layout, LastRuns]:
    """Return a results folder, with the last run of each spec, or of one.

    Raises:
        StoreError: there is no such folder, or it holds no runs.
        UnknownName: none of its runs is of this spec.
    """
    from wasp_cli.cells.runs import LastRuns, last_runs, results_of

    layout = results_of(results)
    last = last_runs(layout)
    if not last.runs and not last.damaged:
        hint = "wasp run SPEC --results DIR writes there, and copies published results"
        raise StoreError(f"no results in '{layout.root}': it holds no runs", hint)
    if spec is None:
        return layout, last
    if last.runs and spec not in last.runs:
        raise UnknownName("spec in these results", spec, last.runs)
    runs = {name: run for name, run in last.runs.items() if name == spec}
    return layout, LastRuns(runs, last.damaged)
