"""A whole results folder, to be made hostile."""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from tests.compare.two_runs import RUN, write_results
from tests.report.invented import invent
from wasp_cli.store.records import write_record
from wasp_cli.store.tables import EPISODES_FILE

LABEL = "goal1 s0 human noisy=0.2"


class UntrustedStore:
    """Results of one cell, with ways to change what they say."""

    def __init__(self, folder: Path) -> None:
        operators = {"noisy": {"mild": 0.2}}
        side = write_results(
            folder / "results",
            lambda _: [invent(0, 3, 0.2, 0.1)],
            methods=["human"],
            operators=operators,
            seeds=[0],
        )
        self.layout = side.layout
        self.key = side.cells[0].key
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
        found: list[dict[str, Any]] = json.loads((self.layout.run(RUN) / "plan.json").read_text())[
            "nodes"
        ]
        return found

    @property
    def cell(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.layout.run(RUN) / "plan.json").read_text())[
            "cells"
        ][0]
        return found

    def specification(self, **facts: Any) -> None:
        self.change(self.layout.run(RUN) / "spec.json", **facts)

    def fails(self, **facts: Any) -> None:
        """Something failed: reports then look for what it blocks."""
        expert = next(node["key"] for node in self.nodes() if node["kind"] == "expert")
        write_record(
            self.layout.failure(expert),
            {"kind": "expert", "label": "goal1 s0 expert", "message": "x", **facts},
        )

    def rows(self, file: str = EPISODES_FILE, **columns: Any) -> None:
        path = self.artifact / file
        table = pq.read_table(path)
        for name, values in columns.items():
            index = table.schema.get_field_index(name)
            table = (
                table.remove_column(index)
                if values is None
                else table.set_column(
                    index, name, values if isinstance(values, pa.Array) else pa.array(values)
                )
            )
        pq.write_table(table, path)
