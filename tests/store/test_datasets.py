"""A folder of cells is a dataset of episodes to everybody's reader."""

import duckdb
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from tests.store.folders import KEYS, folder_of_cells
from wasp_cli.store.artifact import invalidate, why_invalid
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import STEPS_FILE


@pytest.fixture
def layout(tmp_path) -> Layout:
    return folder_of_cells(tmp_path / "results")


READERS = {
    "pandas": lambda folder: pytest.importorskip("pandas").read_parquet(folder),
    "polars": lambda folder: pytest.importorskip("polars").read_parquet(f"{folder}/*/*.parquet"),
    "duckdb": lambda folder: duckdb.sql(f"from '{folder}/*/*.parquet'").fetchall(),
    "arrow": lambda folder: pyarrow.dataset.dataset(folder).to_table(),
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_a_folder_of_cells_reads_as_their_episodes_beside_what_an_invalidated_one_left(
    read, layout
):
    invalidate(layout, "evaluate", KEYS[0], "its bytes changed")
    assert why_invalid(layout, "evaluate", KEYS[0]) == "its bytes changed"
    assert len(read(layout.kind("evaluate"))) == 9


def test_no_column_is_a_reserved_word(layout):
    """Of DuckDB, whose grammar is that of PostgreSQL."""
    names = pq.read_schema(layout.artifact("evaluate", KEYS[0]) / "episodes.parquet").names
    names += pq.read_schema(layout.artifact("evaluate", KEYS[0]) / STEPS_FILE).names
    reserved = {
        word
        for (word,) in duckdb.sql(
            "select keyword_name from duckdb_keywords() where keyword_category = 'reserved'"
        ).fetchall()
    }
    assert {"select", "group"} <= reserved
    assert not {name.lower() for name in names} & reserved
