"""Which runs of a results folder a command is about."""

from __future__ import annotations

from pathlib import Path

from wasp_cli.errors import (
    StoreError,
    UnknownName,
)
from wasp_cli.store.layout import Layout


def reported_runs(results: Path, spec: str | None) -> tuple[Layout, dict[str, str], list[str]]:
    """The last run of each spec, or of one; and what is wrong with those that do not read."""
    from wasp_cli.report.provenance import last_runs
    from wasp_cli.run.record import results_of

    layout = results_of(results)
    runs, damaged = last_runs(layout)
    if not runs and not damaged:
        hint = "wasp run SPEC --results DIR writes there, and copies published results"
        raise StoreError(f"no results in '{layout.root}': it holds no runs", hint)
    if spec is not None and runs and spec not in runs:
        raise UnknownName("spec in these results", spec, runs)
    return layout, {name: run for name, run in runs.items() if spec in (None, name)}, damaged
