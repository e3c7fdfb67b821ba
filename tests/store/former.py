"""A cell as an earlier version wrote it."""

from pathlib import Path

import pyarrow.parquet as pq

from wasp_cli.store.tables import RENAMED, STEPS_FILE, STEPS_KEY, VERSION_KEY


def with_former_names(path: Path, folder: Path) -> Path:
    """Write the cell at `path` to `folder` as version 4 called its columns; returns its file."""
    folder.mkdir(exist_ok=True)
    for name, key in ((path.name, VERSION_KEY), (STEPS_FILE, STEPS_KEY)):
        table = pq.read_table(path.with_name(name)).rename_columns(RENAMED).replace_schema_metadata({key: b"4"})
        pq.write_table(table, folder / name, write_page_checksum=True)
    return folder / path.name
