"""Whole results folders of invented cells, to be compared."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tests.report.invented import invent, write_rows
from tests.run.recorded import at
from wasp_cli.cells.asked import Asked, asked_of, asked_of_grid
from wasp_cli.cells.runs import read_run
from wasp_cli.metrics.episode import Trajectory
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import plan_against
from wasp_cli.spec.model import validate
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.records import write_record
from wasp_cli.store.tables import CellIdentity

SPEC: Mapping[str, Any] = {
    "name": "tiny",
    "preset": "smoke",
    "tasks": ["goal1"],
    "methods": ["human", "wasp"],
    "seeds": [0, 1],
    "operators": {"noisy": {"mild": 0.2}, "laggy": {"mild": 0.5}},
}
RUN = "20260501-120000-tiny-0000"
Make = Callable[[CellIdentity], list[Trajectory]]


def episodes(identity: CellIdentity, count: int = 8, risk: float = 0.1) -> list[Trajectory]:
    """So many episodes, each with another number of goals."""
    return [invent(3 * e + 17 * identity.seed, e % 5, 0.2, risk) for e in range(count)]


def write_results(
    folder: Path, make: Make = episodes, provenance: Mapping[str, Any] | None = None, **changes: Any
) -> Asked:
    """The results of a run whose every node was computed, as a worker would leave them."""
    layout = Layout(folder)
    layout.prepare()
    spec = validate({**SPEC, **changes})
    grid = lay_out(spec)
    run = layout.run(RUN)
    for part in ("logs", "running"):
        (run / part).mkdir(parents=True)
    write_record(run / "spec.json", spec.model_dump(mode="json"))
    write_record(run / "plan.json", {"spec": spec.name, **plan_against(grid, layout).as_json()})
    (run / "journal.jsonl").write_text(json.dumps({"at": at(0), "event": "run started"}) + "\n")
    cells = {cell.key: cell.identity for cell in asked_of_grid(layout, RUN, spec, grid).cells}
    for node in grid.nodes:
        staging = staging_folder(layout, node.key)
        if node.key in cells:
            identity = cells[node.key]
            write_rows(staging, identity, make(identity))
        commit(layout, node.kind, node.key, staging, manifest_of(node, provenance or {}))
    return asked_of(read_run(layout, RUN))


def manifest_of(node: Node, provenance: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "kind": node.kind,
        "key": node.key,
        "label": node.label,
        "task": node.task,
        "seed": node.seed,
        "axes": dict(node.axes),
        "config": dict(node.config),
        "settings": dict(node.settings),
        "sources": {"wasp_cli.tasks.base": "same"},
        "upstream": {name: needed.key for name, needed in node.needs.items()},
        "upstream_kinds": {name: needed.kind for name, needed in node.needs.items()},
        "summary": {},
        "provenance": {"versions": {"torch": "2.13.0"}, "processor": "one", **provenance},
    }
