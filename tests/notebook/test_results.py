"""`wasp_cli.results` over the small run that is checked in, which earlier versions wrote: rows,
choices, tables, and what goes wrong.
"""

import contextlib
import csv
import io
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import duckdb
import numpy as np
import pyarrow.compute as pc
import pytest

import wasp_cli
from tests.store.folders import folder_of_cells
from tests.test_docs import ROOT, blocks
from tests.video.replayed import CELL, made_store
from wasp_cli.errors import ArtifactError, StoreError, UnknownName, UsageError
from wasp_cli.notebook import Results
from wasp_cli.store.tables import cell_file, read_episodes

GOLDEN = Path(__file__).parents[1] / "golden"
BY_TEN = "bc484850ba1f80f0a26a"  # a published cell
NAMES = ["key", "spec", "task", "method", "variant", "operator", "severity", "value", "seed"]


@pytest.fixture(scope="module")
def results() -> Results:
    return wasp_cli.results(GOLDEN / "store")


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    return Path(shutil.copytree(GOLDEN / "store", tmp_path / "results"))


def test_the_package_lists_its_public_names() -> None:
    assert {"results", "load_world_model", "__version__"} <= {*dir(wasp_cli)}
    with pytest.raises(AttributeError, match="no attribute 'result'"):
        wasp_cli.result  # noqa: B018


def test_results_are_lazy() -> None:
    """Neither torch nor what draws is imported."""
    code = f"""
import sys
import wasp_cli
assert not [name for name in sys.modules if name.startswith("wasp_cli.")]
shown = repr(wasp_cli.results({str(GOLDEN / "store")!r}))
assert not {{"torch", "mujoco", "matplotlib", "pandas", "stable_baselines3"}} & {{*sys.modules}}, "heavy imports"
print(shown)
"""
    told = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert "spec='golden': 32 cells" in told


def test_every_row_names_its_cell_its_spec_and_its_severity(results: Results) -> None:
    table = results.episodes()
    assert table.column_names[: len(NAMES)] == NAMES
    assert table.num_rows == 96
    assert {*table["spec"].to_pylist()} == {"golden"}
    assert {*table["severity"].to_pylist()} == {"mild", "severe", "moderate", None}
    row = next(
        row
        for row in table.to_pylist()
        if row["method"] == "wasp" and row["operator"] == "noisy" and row["severity"] == "severe"
    )
    stored = read_episodes([cell_file(GOLDEN / "store" / "store" / "evaluate" / row["key"])])
    assert {*zip(stored["operator"].to_pylist(), stored["value"].to_pylist(), strict=True)} == {
        ("noisy", row["value"])
    }
    for other in (results.steps(), results.branches()):
        assert other.column_names[: len(NAMES)] == NAMES


def test_rows_are_those_of_the_files(results: Results) -> None:
    cell = results.cell("goal1 s1 wasp laggy=0.7")
    stored = read_episodes([cell_file(GOLDEN / "store" / "store" / "evaluate" / cell.key)])
    for name in ("return", "cost", "episode_seed", "tau_c"):
        assert cell.episodes()[name].to_pylist() == stored[name].to_pylist()
    steps = cell.steps()
    by_episode = steps.group_by("episode").aggregate([("reward", "sum")]).sort_by("episode")
    assert np.allclose(by_episode["reward_sum"].to_numpy(), stored["return"].to_numpy(), rtol=1e-5)
    assert cell.steps(1).num_rows == stored["decisions"].to_pylist()[1]
    with pytest.raises(UsageError, match="no episode 99"):
        cell.steps(99)
    assert results.steps(method="wasp", key=cell.key, columns="reward").column_names == [
        *NAMES,
        "reward",
    ]


def test_what_is_published_says_what_it_lacks_and_what_has_two_cells() -> None:
    published = wasp_cli.results(ROOT / "results" / "published")
    with pytest.warns(UserWarning, match="^1 of 30 episodes have steps"):
        assert {*published.steps(key=BY_TEN)["episode"].to_pylist()} == {0}
    with pytest.raises(UsageError, match="the steps of episode 5 are not here"):
        published.cell(BY_TEN).steps(5)
    with pytest.warns(UserWarning, match=r"^\d+ of \d+ cells share their names with another"):
        published.episodes(method="ida", columns="return")


def test_rows_are_chosen_by_names(results: Results) -> None:
    found = results.episodes(
        method=["wasp", "ida"], operator="noisy", severity="mild", seed=1, columns=["cost"]
    )
    assert found.column_names == [*NAMES, "cost"]
    assert {
        *zip(
            *(found[name].to_pylist() for name in ("method", "operator", "severity", "seed")),
            strict=True,
        )
    } == {
        ("wasp", "noisy", "mild", 1),
        ("ida", "noisy", "mild", 1),
    }
    assert results.episodes(seed="1", value="0.7").equals(results.episodes(seed=1, value=0.7))  # type: ignore[arg-type]
    assert (
        results.episodes(method="wasp", variant="full").num_rows
        < results.episodes(method="wasp").num_rows
    )
    # both are there, not together
    assert results.episodes(operator="laggy", severity="mild").num_rows == 0


def test_a_misspelt_name_is_no_empty_table(results: Results) -> None:
    with pytest.raises(UnknownName, match="wsap") as raised:
        results.episodes(method="wsap")
    assert "'wasp'" in (raised.value.hint or "")
    with pytest.raises(UnknownName):
        results.trained(kind="worldmodel")
    with pytest.raises(KeyError, match="no column 'costs'"):
        results.episodes(columns=["costs"])
    with pytest.raises(TypeError, match="methods"):
        results.episodes(methods="wasp")  # type: ignore[call-arg]
    with pytest.raises(UnknownName):
        results.cell("goal1 s1 wasp laggy=0.8")


def test_tables_are_those_of_the_report(results: Results) -> None:
    for name, file in (
        ("main", "table1"),
        ("table2", "table2"),
        ("figure3", "figure3"),
        ("statistics", "statistics"),
    ):
        table = results.table(name)
        with (GOLDEN / "report" / f"{file}.csv").open() as text:
            rows = list(csv.DictReader(text))
        assert table.column_names == list(rows[0])
        for ours, theirs in zip(table.to_pylist(), rows, strict=True):
            for column, printed in theirs.items():
                value = ours[column]
                if isinstance(value, float) and printed:
                    assert value == pytest.approx(float(printed), abs=1e-9)
                else:
                    assert printed == ("" if value is None else str(value))
    with pytest.raises(UnknownName, match="tabel2"):
        results.table("tabel2")


def test_trained_parts_have_their_numbers(results: Results) -> None:
    models = results.trained(kind="world_model")
    assert models["seed"].to_pylist() == [0, 1]
    manifest = json.loads((Path(models["folder"][0].as_py()) / "_manifest.json").read_text())
    assert models["final_reward_loss"][0].as_py() == manifest["summary"]["final_reward_loss"]
    assert {"expert", "critics", "policies"} <= {*results.trained()["kind"].to_pylist()}
    assert {*results.trained(seed=1)["seed"].to_pylist()} == {1}


def test_what_is_not_computed_has_no_rows(copied: Path) -> None:
    cell = wasp_cli.results(copied).cell("goal1 s1 wasp laggy=0.7")
    shutil.rmtree(copied / "store" / "evaluate" / cell.key)
    found = wasp_cli.results(copied)
    assert found.missing == ["goal1 s1 wasp laggy=0.7"]
    assert found.episodes().num_rows == 93
    with pytest.raises(UsageError, match="not computed yet"):
        found.cell("goal1 s1 wasp laggy=0.7")


def test_a_folder_with_another_cell_is_refused(copied: Path) -> None:
    one, other = (
        wasp_cli.results(copied).cell(f"goal1 s{seed} wasp laggy=0.7").key for seed in (0, 1)
    )
    cells = copied / "store" / "evaluate"
    shutil.copy(cell_file(cells / one), cell_file(cells / other))
    with pytest.raises(StoreError, match="another cell"):
        wasp_cli.results(copied).episodes()


def test_the_spec_that_ran_last_is_shown_and_others_by_name(copied: Path) -> None:
    (run,) = (copied / "runs").iterdir()
    later = shutil.copytree(run, copied / "runs" / "20270101-000000-later-0000")
    plan = json.loads((later / "plan.json").read_text())
    plan["spec"], plan["cells"] = "later", plan["cells"][:2]
    (later / "plan.json").write_text(json.dumps(plan))
    assert wasp_cli.results(copied).specs == ["golden", "later"]
    assert wasp_cli.results(copied).episodes().num_rows == 6
    assert wasp_cli.results(copied, spec="golden").episodes().num_rows == 96
    both = wasp_cli.results(copied, spec=["golden", "later"])
    assert pc.value_counts(both.episodes()["spec"]).to_pylist() == [
        {"values": "golden", "counts": 96},
        {"values": "later", "counts": 6},
    ]
    assert both.cell("goal1 s0 human noisy=0.2").key == plan["cells"][0]["key"]
    with pytest.raises(UsageError, match="a table is of one spec"):
        both.table()
    with pytest.raises(UnknownName, match="goldne"):
        wasp_cli.results(copied, spec="goldne")
    none = wasp_cli.results(copied, spec=[])
    assert (none.cells, none.trained().num_rows, "spec=none: 0 cells" in repr(none)) == (
        [],
        0,
        True,
    )
    (later / "plan.json").write_text(json.dumps({**plan, "cells": [], "branched": []}))
    with pytest.raises(UnknownName, match="unknown table 'main'"):
        wasp_cli.results(copied).table()
    for parts in (3, [3], [{"kind": "x"}]):
        (later / "plan.json").write_text(json.dumps({**plan, "parts": parts}))
        with pytest.raises(
            ArtifactError, match="cannot read the plan of run '20270101-000000-later-0000'"
        ):
            wasp_cli.results(copied).trained()
    (later / "plan.json").write_text("{")
    with pytest.warns(UserWarning, match="plan.json' is damaged"):
        assert wasp_cli.results(copied).specs == ["golden"]


def test_a_folder_without_runs_shows_its_store(copied: Path) -> None:
    whole = (
        wasp_cli.results(copied)
        .episodes()
        .sort_by([("key", "ascending"), ("episode", "ascending")])
    )
    branched = wasp_cli.results(copied).branches().num_rows
    shutil.rmtree(copied / "runs")
    found = wasp_cli.results(copied)
    table = found.episodes()
    assert table.drop_columns(["spec", "severity"]).equals(whole.drop_columns(["spec", "severity"]))
    assert table["spec"].null_count == table["severity"].null_count == 96
    assert found.branches().num_rows == branched
    with pytest.raises(StoreError, match="no such folder"):
        wasp_cli.results(copied / "nowhere")
    with pytest.raises(StoreError, match="neither runs nor a store"):
        wasp_cli.results(copied / "store")


def test_links_out_of_the_folder_are_not_followed(copied: Path, tmp_path: Path) -> None:
    key = wasp_cli.results(copied).cell("goal1 s1 wasp laggy=0.7").key
    folder = copied / "store" / "evaluate" / key
    folder.rename(tmp_path / "outside")
    folder.symlink_to(tmp_path / "outside")
    with pytest.raises(StoreError, match="is a link"):
        wasp_cli.results(copied).episodes()


def test_a_record_that_is_not_ours_is_an_expected_error(copied: Path) -> None:
    (run,) = (copied / "runs").iterdir()
    plan = json.loads((run / "plan.json").read_text())
    plan["cells"][0]["key"] = "../../etc"
    (run / "plan.json").write_text(json.dumps(plan))
    with pytest.raises(Exception, match="cannot read the plan of run"):
        wasp_cli.results(copied).episodes()


# What docs/results.md shows is run: its lines over the small run that is checked in, its readers
# over cells of today's layout.


PAGE = ROOT / "docs" / "results.md"
LINES = [
    line[2:]
    for block in blocks(PAGE, "console")
    for line in block.splitlines()
    if line.startswith("$ python")
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A current folder as after a run in a checkout."""
    place = tmp_path_factory.mktemp("page")
    shutil.copytree(ROOT / "tests" / "golden" / "store", place / "results")
    shutil.copytree(ROOT / "results" / "published", place / "results" / "published")
    return place


@pytest.mark.parametrize("line", LINES)
def test_lines_run(line: str, folder: Path) -> None:
    pytest.importorskip("pandas")
    *python, program = shlex.split(line)
    assert python == ["python", "-c"]
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(program, {})
    assert printed.getvalue().strip() not in ("", "0", "[]")


def test_frames_are_made_as_shown(folder: Path) -> None:
    """The first Python block, but for its replay: the models of this run are not checked in."""
    pytest.importorskip("pandas")
    block = blocks(PAGE, "python")[0].partition("\nfor frame")[0]
    printed: list[object] = []
    with contextlib.chdir(folder):
        exec(block, {"print": printed.append})
    assert str(printed[0]).count("laggy") == 5  # Human-only, IDA, Diffusion, WASP and an ablation


def test_other_readers_read_the_files_as_shown(tmp_path: Path) -> None:
    for module in ("pandas", "polars"):
        pytest.importorskip(module)
    layout = folder_of_cells(tmp_path / "results", method="wasp")
    text = next(block for block in blocks(PAGE, "python") if "read_parquet" in block)
    imports, *readers = [line for line in text.splitlines() if line]
    names: dict[str, object] = {}
    exec(imports, names)
    assert len(readers) == 3
    with contextlib.chdir(tmp_path):
        assert [len(eval(line, names)) for line in readers] == [9, 9, 9]
        (sql,) = blocks(PAGE, "sql")
        episodes, steps = (duckdb.sql(query).fetchall() for query in re.findall(r"[^;]+;", sql))
    assert [row[:2] for row in episodes] == [("goal1", "wasp")]
    assert len({row[0] for row in steps}) == 3
    assert layout.store.is_dir()


# A cell of `wasp_cli.results` played again.


@pytest.fixture(scope="module")
def replayable(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_store(tmp_path_factory.mktemp("replay"))


def test_an_episode_has_its_frames(replayable: Path) -> None:
    cell = wasp_cli.results(replayable).cell("race1 s0 wasp noisy=0.4")
    assert cell.key == CELL == cell.manifest["key"]
    frames = list(cell.replay(episode=1, every=10))
    assert {(frame.shape, frame.dtype) for frame in frames} == {((704, 976, 3), np.dtype(np.uint8))}
    decisions = cell.episodes()["decisions"][1].as_py()
    assert len(frames) == len({*range(0, decisions, 10), decisions - 1})
    assert len({frame.tobytes() for frame in frames}) == len(frames)
    with pytest.raises(UsageError, match="every=0 is no number of decisions"):
        next(cell.replay(episode=1, every=0))
