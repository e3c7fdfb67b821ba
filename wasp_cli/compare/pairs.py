"""Which runs of two results folders are held against each other: the last one of each spec."""

from __future__ import annotations

from pathlib import Path

from wasp_cli.compare.runs import Side
from wasp_cli.errors import ArtifactError, StoreError, UnknownName, UsageError
from wasp_cli.report.provenance import last_runs
from wasp_cli.run.record import read_run, results_of


def pairs(
    first: Path, second: Path, spec: str | None = None, spec_a: str | None = None, spec_b: str | None = None
) -> list[tuple[Side, Side]]:
    """Return the pairs of runs to compare: two named specs, or every spec that has run in both folders.

    Raises:
        UsageError: a folder has no readable results, or not this spec; or no spec has run in both.
    """
    if (spec_a is None) != (spec_b is None) or (spec is not None and spec_a is not None):
        what = "--spec-a and --spec-b need each other, and exclude --spec"
        raise UsageError(what, "wasp compare A B --spec-a mine --spec-b other")
    spec_a, spec_b = (spec, spec) if spec is not None else (spec_a, spec_b)
    try:
        layouts = [results_of(folder) for folder in (first, second)]
        runs = [last_runs(layout)[0] for layout in layouts]
        for name, known, folder in ((spec_a, runs[0], first), (spec_b, runs[1], second)):
            if name is not None and name not in known:
                raise UnknownName("spec", name, known, f"no spec '{name}' has run in '{folder}'")
        names = [(spec_a, spec_b)] if spec_a is not None and spec_b is not None else [(name, name) for name in runs[0] if name in runs[1]]
        if not names:
            which = "; ".join(f"'{folder}' has {', '.join(known) or 'none'}" for folder, known in zip((first, second), runs, strict=True))
            raise UsageError(f"no spec has run in both folders: {which}", "choose one of each with --spec-a and --spec-b")
        found = []
        for pair in names:
            sides = [(layout, read_run(layout, known[name])) for layout, known, name in zip(layouts, runs, pair, strict=True)]
            a, b = (Side(layout, run.run_id, run.spec, run.cells) for layout, run in sides)
            found.append((a, b))
    except (StoreError, ArtifactError) as error:
        raise UsageError(error.message, error.hint) from error
    return found
