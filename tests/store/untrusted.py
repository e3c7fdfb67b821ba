"""A whole results folder, to be made hostile."""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from tests.report.invented import invent, write_rows
from tests.run.recorded import at
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import plan_against
from wasp_cli.spec.model import validate
from wasp_cli.store.artifact import commit, staging_folder, write_record
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import EPISODES_FILE, CellIdentity

RUN = "20260501-120000-tiny-0000"
LABEL = "goal1 s0 human noisy=0.2"
SPEC = {"name": "tiny", "preset": "smoke", "tasks": ["goal1"], "methods": ["human"], "operators": {"noisy": {"mild": 0.2}}, "seeds": [0]}


class UntrustedStore:
    """Results of one cell, with ways to change what they say."""

    def __init__(self, folder: Path) -> None:
        self.layout = Layout(folder / "results")
        self.layout.prepare()
        self.spec = validate(SPEC)
        grid = lay_out(self.spec)
        ((cell, node),) = grid.cells
        self.key = node.key
        write_run_of(self.layout, self.spec.model_dump(mode="json"), plan_against(grid, self.layout).as_json())
        for each in grid.nodes:
            staging = staging_folder(self.layout, each.key)
            if each.kind == "evaluate":
                identity = CellIdentity(cell.task, cell.method, cell.assistant, cell.operator, cell.value, cell.seed)
                write_rows(staging, identity, [invent(0, 3, 0.2, 0.1)])
            commit(self.layout, each.kind, each.key, staging, manifest_of(each.kind, each.key, each.label, upstream_of(each)))
        self.layout.log(RUN, LABEL, self.key).write_text("log\n")

    @property
    def artifact(self) -> Path:
        return self.layout.artifact("evaluate", self.key)

    def change(self, path: Path, **facts: Any) -> None:
        write_record(path, {**json.loads(path.read_text()), **facts})

    def manifest(self, **facts: Any) -> None:
        self.change(self.artifact / "_manifest.json", **facts)

    def plan(self, **facts: Any) -> None:
        self.change(self.layout.run(RUN) / "plan.json", **facts)

    def nodes(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = json.loads((self.layout.run(RUN) / "plan.json").read_text())["nodes"]
        return found

    @property
    def cell(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.layout.run(RUN) / "plan.json").read_text())["cells"][0]
        return found

    def specification(self, **facts: Any) -> None:
        self.change(self.layout.run(RUN) / "spec.json", **facts)

    def fails(self, **facts: Any) -> None:
        """Something failed: reports then look for what it blocks."""
        expert = next(node["key"] for node in self.nodes() if node["kind"] == "expert")
        write_record(self.layout.failure(expert), {"kind": "expert", "label": "goal1 s0 expert", "message": "x", **facts})

    def rows(self, file: str = EPISODES_FILE, **columns: Any) -> None:
        path = self.artifact / file
        table = pq.read_table(path)
        for name, values in columns.items():
            index = table.schema.get_field_index(name)
            table = (
                table.remove_column(index)
                if values is None
                else table.set_column(index, name, values if isinstance(values, pa.Array) else pa.array(values))
            )
        pq.write_table(table, path)

    def played(self, action_repeat: int) -> None:
        """The manifest says what is needed to play the cell again."""
        self.manifest(settings={"action_repeat": action_repeat}, axes={"method": "human", "operator": "noisy", "value": 0.2})


def upstream_of(node: Node) -> dict[str, tuple[str, str]]:
    return {name: (needed.kind, needed.key) for name, needed in node.needs.items()}


def manifest_of(kind: str, name: str, label: str, upstream: dict[str, tuple[str, str]]) -> dict[str, Any]:
    return {
        "kind": kind, "key": name, "label": label, "task": "goal1", "seed": 0, "axes": {"method": "human"}, "config": {}, "settings": {},
        "upstream": {part: needed for part, (_, needed) in upstream.items()},
        "upstream_kinds": {part: needed for part, (needed, _) in upstream.items()},
        "summary": {"number": 1}, "provenance": {"started_at": "2026-05-01T12:00:00+00:00", "seconds": 1.0},
    }  # fmt: skip


def write_run_of(layout: Layout, spec: dict[str, Any], plan: dict[str, Any]) -> None:
    folder = layout.run(RUN)
    for part in ("logs", "running"):
        (folder / part).mkdir(parents=True)
    write_record(folder / "spec.json", spec)
    write_record(folder / "plan.json", {"spec": spec["name"], **plan})
    (folder / "journal.jsonl").write_text(json.dumps({"at": at(0), "event": "run started"}) + "\n")
