"""`python -m tests.benchmarks.times RESULTS... > wasp_cli/plan/times.json`: what nodes took, as `wasp plan` estimates from it.

The results have to be computed on this machine, and while nothing else ran.
"""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from wasp_cli.plan import schedule as estimates
from wasp_cli.plan.recorded import planned_runs
from wasp_cli.run.record import read_run, results_of
from wasp_cli.store.artifact import exists, read_manifest


def times(folders: Sequence[Path]) -> Any:
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


def figures_of(manifests: Iterable[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    """Return the figures of what was computed on this machine.

    Args:
        manifests: each with the preset of its spec.
    """
    times: dict[str, dict[str, list[float]]] = {}
    for preset, manifest in manifests:
        kind, axes, provenance = manifest["kind"], manifest["axes"], manifest["provenance"]
        if "earlier" not in provenance:  # what took rows over says nothing of its like
            seconds = float(provenance["seconds"]) / estimates.units(kind, manifest["config"])
            times.setdefault(preset, {}).setdefault(estimates.figures_like(kind, manifest["task"], axes)[0], []).append(seconds)
    seconds_of = {preset: {name: _short(median(values)) for name, values in sorted(found.items())} for preset, found in times.items()}
    return {"speed": _short(estimates.speed()), "seconds": seconds_of}


def _short(number: float) -> float:
    return float(f"{number:.3g}")


if __name__ == "__main__":
    print(json.dumps(times([Path(folder) for folder in sys.argv[1:]]), indent=1))
