"""A cell as earlier versions wrote it: one file, with the steps inside the rows of episodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from wasp_cli.store.tables import FORMER_FILE, RENAMED, SCHEMA, STEP, STEPS_FILE, STEPS_KEY, VERSION_KEY, lacking


def write_former(path: Path, folder: Path, version: int = 2) -> Path:
    """Write the cell at `path` to `folder` in an earlier version; returns its file.

    Version 1 had `safe` as one number, `case2_share`, and nothing else of a plan.
    """
    table, steps = pq.read_table(path), pq.read_table(path.with_name(STEPS_FILE))
    ends = np.cumsum([0, *np.asarray(table["decisions"])], dtype=np.int32)
    columns = {field.name: steps[field.name].combine_chunks() for field in STEP}
    if version == 1:
        absent = ("g_return", "safe", "case2", "plan", "plan_cost", "plan_return", "alone_cost", "alone_return")
        columns = {name: column for name, column in columns.items() if name not in absent}
        columns["safe"] = pa.array(np.where(np.asarray(columns["gate"]) == 1, 3, 0), pa.int16())
        columns["case2_share"] = pa.array([0.5] * len(steps), pa.float32())
    fields = list(STEP) if version == 2 else [pa.field(name, column.type) for name, column in columns.items()]
    nested = pa.ListArray.from_arrays(ends, pa.StructArray.from_arrays(list(columns.values()), fields=fields))
    times = pa.ListArray.from_arrays(ends, steps["decision_ms"].combine_chunks())
    table = (
        table.select([name for name in SCHEMA.names if name not in lacking(version)])
        .rename_columns(RENAMED)
        .append_column("decision_ms", times)
        .append_column("steps", nested)
    )
    folder.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.replace_schema_metadata({VERSION_KEY: str(version).encode()}), folder / FORMER_FILE, write_page_checksum=True)
    return folder / FORMER_FILE


def with_former_names(path: Path, folder: Path) -> Path:
    """Write the cell at `path` to `folder` as version 4 called its columns; returns its file."""
    folder.mkdir()
    for name, key in ((path.name, VERSION_KEY), (STEPS_FILE, STEPS_KEY)):
        table = pq.read_table(path.with_name(name)).rename_columns(RENAMED).replace_schema_metadata({key: b"4"})
        pq.write_table(table, folder / name, write_page_checksum=True)
    return folder / path.name
