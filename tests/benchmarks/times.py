"""What nodes take, as `wasp plan` estimates from it: the figures of `wasp_cli/plan/times.json`.

python -m tests.benchmarks.times RESULTS...                        of results computed on this
machine, while nothing else ran python -m tests.benchmarks.times --published specs/table1.yaml   of
what is published of a spec: the least time of each kind of node,
                                                                   since other work ran beside most
                                                                   of them
"""

import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from wasp_cli.cells.asked import asked_of
from wasp_cli.cells.runs import planned_runs, results_of
from wasp_cli.plan import schedule as estimates
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.spec.load import load
from wasp_cli.store.artifact import exists, read_manifest
from wasp_cli.store.layout import Layout


def times(folders: Sequence[Path]) -> Any:
    found = {}
    for folder in folders:
        layout = results_of(folder)
        for run in planned_runs(layout):
            preset = asked_of(run).spec.preset
            for node in run.nodes.values():
                if exists(layout, node.kind, node.key):
                    manifest = read_manifest(layout, node.kind, node.key)
                    if manifest["provenance"].get("run") == run.run_id:
                        found[node.key] = (preset, manifest)
    return figures_of(found.values())


def figures_of(
    manifests: Iterable[tuple[str, Mapping[str, Any]]],
    typical: Callable[[list[float]], float] = median,
) -> dict[str, Any]:
    """Return the figures of what was computed on this machine.

    Args:
        manifests: each with the preset of its spec.
        typical: makes one figure of those of several nodes.
    """
    times: dict[str, dict[str, list[float]]] = {}
    for preset, manifest in manifests:
        kind, axes, provenance = manifest["kind"], manifest["axes"], manifest["provenance"]
        if "earlier" not in provenance:  # what took rows over says nothing of its like
            seconds = float(provenance["seconds"]) / estimates.units(kind, manifest["config"])
            times.setdefault(preset, {}).setdefault(
                estimates.figures_like(kind, manifest["task"], axes)[0], []
            ).append(seconds)
    seconds_of = {
        preset: {name: _short(typical(values)) for name, values in sorted(found.items())}
        for preset, found in times.items()
    }
    return {"speed": _short(estimates.speed()), "seconds": seconds_of}


def published(spec: Path) -> Any:
    """Return the figures of what is published of a spec."""
    loaded = load(spec).spec
    grid = lay_out_over(loaded, Layout(Path("results")), "published")
    reused = [reused.offer for reused in grid.reused.values()]
    return figures_of(
        [
            (loaded.preset, read_manifest(Layout(Path("results/published")), offer.kind, offer.key))
            for offer in reused
        ],
        min,
    )


def _short(number: float) -> float:
    return float(f"{number:.3g}")


if __name__ == "__main__":
    made = (
        published(Path(sys.argv[2]))
        if sys.argv[1] == "--published"
        else times([Path(folder) for folder in sys.argv[1:]])
    )
    print(json.dumps(made, indent=1))
