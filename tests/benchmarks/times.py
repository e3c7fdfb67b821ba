"""`python -m tests.benchmarks.times RESULTS... > wasp_cli/plan/times.json`: what nodes took, as `wasp plan` estimates from it.

The results have to be computed on this machine, and while nothing else ran.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from wasp_cli.plan.recorded import planned_runs
from wasp_cli.plan.times import figures_of
from wasp_cli.run.record import read_run, results_of
from wasp_cli.store.artifact import exists, read_manifest


def times(folders: Sequence[Path]) -> Any:
    """Return the figures of what was computed in results folders."""
    found = {}
    for folder in folders:
        layout = results_of(folder)
        for run in planned_runs(layout):
            preset = read_run(layout, run.run_id).spec.preset
            for node in run.nodes.values():
                if exists(layout, node.kind, node.key):
                    manifest = read_manifest(layout, node.kind, node.key)
                    if manifest["provenance"].get("run") == run.run_id:
                        found[node.key] = (preset, manifest)
    return figures_of(found.values())


if __name__ == "__main__":
    print(json.dumps(times([Path(folder) for folder in sys.argv[1:]]), indent=1))
