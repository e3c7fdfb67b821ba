"""A folder of cells is a dataset of episodes to everybody's reader, and cells under their former names are read as before."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import duckdb
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from tests.store.folders import KEYS, folder_of_cells
from wasp_cli.store.artifact import (
    FORMER_WHY,
    WHY,
    damage,
    exists,
    invalidate,
    read_manifest,
    stored_keys,
    why_invalid,
)
from wasp_cli.store.find import find_cell
from wasp_cli.store.index import scan
from wasp_cli.store.layout import FORMER_MANIFEST, MANIFEST, Layout
from wasp_cli.store.tables import FORMER_STEPS_FILE, STEPS_FILE, read_steps, same_rows


@pytest.fixture
def layout(tmp_path: Path) -> Layout:
    return folder_of_cells(tmp_path / "results")


def pandas_folder(folder: Path) -> Any:
    return pytest.importorskip("pandas").read_parquet(folder)


def polars_glob(folder: Path) -> Any:
    return pytest.importorskip("polars").read_parquet(f"{folder}/*/*.parquet")


def polars_deep_glob(folder: Path) -> Any:
    return pytest.importorskip("polars").read_parquet(f"{folder}/**/*.parquet")


def polars_folder(folder: Path) -> Any:
    return pytest.importorskip("polars").scan_parquet(folder, hidden_file_prefix="_").collect()


def duckdb_glob(folder: Path) -> Any:
    return duckdb.sql(f"from '{folder}/*/*.parquet'").fetchall()


def duckdb_deep_glob(folder: Path) -> Any:
    return duckdb.sql(f"from '{folder}/**/*.parquet'").fetchall()


def arrow_table(folder: Path) -> Any:
    return pq.read_table(folder)


def arrow_dataset(folder: Path) -> Any:
    return pyarrow.dataset.dataset(folder).to_table()


READERS = (pandas_folder, polars_glob, polars_deep_glob, polars_folder, duckdb_glob, duckdb_deep_glob, arrow_table, arrow_dataset)


@pytest.mark.parametrize("read", READERS)
def test_a_folder_of_cells_reads_as_their_episodes(read: Callable[[Path], Any], layout: Layout) -> None:
    assert len(read(layout.kind("evaluate"))) == 9


@pytest.mark.parametrize("read", READERS)
def test_what_an_invalidated_cell_leaves_is_no_obstacle(read: Callable[[Path], Any], layout: Layout) -> None:
    invalidate(layout, "evaluate", KEYS[0], "its bytes changed")
    assert why_invalid(layout, "evaluate", KEYS[0]) == "its bytes changed"
    assert len(read(layout.kind("evaluate"))) == 9


def test_no_column_is_a_reserved_word(layout: Layout) -> None:
    """Of DuckDB, whose grammar is that of PostgreSQL."""
    names = pq.read_schema(layout.artifact("evaluate", KEYS[0]) / "episodes.parquet").names
    names += pq.read_schema(layout.artifact("evaluate", KEYS[0]) / STEPS_FILE).names
    reserved = {word for (word,) in duckdb.sql("select keyword_name from duckdb_keywords() where keyword_category = 'reserved'").fetchall()}
    assert {"select", "group"} <= reserved
    assert not {name.lower() for name in names} & reserved


@pytest.fixture
def former(layout: Layout) -> Layout:
    """The same, under the names of earlier versions."""
    for folder in layout.kind("evaluate").iterdir():
        text = (folder / MANIFEST).read_text().replace(f'"{STEPS_FILE}"', f'"{FORMER_STEPS_FILE}"')
        (folder / FORMER_MANIFEST).write_text(text)
        (folder / MANIFEST).unlink()
        (folder / STEPS_FILE).rename(folder / FORMER_STEPS_FILE)
    return layout


def test_cells_under_former_names_are_whole(former: Layout) -> None:
    assert stored_keys(former, "evaluate") == {*KEYS}
    assert all(exists(former, "evaluate", key) for key in KEYS)
    index = scan(former, ["evaluate"], lambda manifest: {"label": manifest["label"]}, 1)
    assert {key: entry.facts["label"] for key, entry in index.whole["evaluate"].items()} == {
        key: f"goal1 s{seed} ida laggy=0.5" for seed, key in enumerate(KEYS)
    }
    assert not index.damaged


def test_cells_under_former_names_are_found_and_read(former: Layout) -> None:
    found = find_cell(former, "goal1 s1 ida laggy=0.5")
    assert found.key == KEYS[1]
    assert find_cell(former, str(found.path)).key == KEYS[1]
    assert read_steps(found.path).num_rows == 15
    assert not same_rows(found.path, find_cell(former, KEYS[2]).path)


def test_damage_under_former_names_is_told(former: Layout) -> None:
    (former.artifact("evaluate", KEYS[0]) / FORMER_STEPS_FILE).unlink()
    assert "is gone" in (damage(former, "evaluate", KEYS[0]) or "")
    invalidate(former, "evaluate", KEYS[1], "its bytes changed")
    assert stored_keys(former, "evaluate") == {KEYS[0], KEYS[2]}
    (former.artifact("evaluate", KEYS[1]) / WHY).rename(former.artifact("evaluate", KEYS[1]) / FORMER_WHY)
    assert why_invalid(former, "evaluate", KEYS[1]) == "its bytes changed"
    assert read_manifest(former, "evaluate", KEYS[2])["key"] == KEYS[2]
