"""`wasp export`: stored curves and the main table, read again by TensorBoard and Trackio themselves."""

import shutil
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.report.golden_store import STORE


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(STORE, tmp_path_factory.mktemp("golden") / "results"))


def test_tensorboard_reads_curves_and_the_main_table(results: Path, tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    done = run_here("export", results, "--tensorboard", tmp_path / "runs", columns=200)
    assert done.exit_code == 0, done.stderr
    runs = {str(path.parent.relative_to(tmp_path / "runs/golden")): path.parent for path in (tmp_path / "runs").rglob("events.*")}
    assert {"goal1/table/IDA", "goal1/table/Human-only", "goal1/s0/Expert"} <= runs.keys()
    numbers = EventAccumulator(str(runs["goal1/table/IDA"]))
    numbers.Reload()
    from wasp_cli.notebook.results import open_results

    rows = open_results(results).table().to_pylist()
    (row,) = [row for row in rows if row["method"] == "IDA"]
    assert numbers.Scalars("cost")[0].value == pytest.approx(row["cost"])
    curve = EventAccumulator(str(runs["goal1/s0/Expert"]))
    curve.Reload()
    steps = [point.step for point in curve.Scalars("return")]
    assert len(steps) > 1
    assert steps == sorted(steps)
    again = run_here("export", results, "--tensorboard", tmp_path / "runs", columns=200)
    assert (again.exit_code, "is there already" in again.stderr) == (2, True)


def test_trackio_reads_them_too(results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path))  # the package reads it once, when it is imported
    import trackio

    done = run_here("export", results, "--trackio", tmp_path, columns=200)
    assert done.exit_code == 0, done.stderr
    assert "Trackio metrics" not in done.stdout
    names = {run.name for run in trackio.Api().runs("golden")}
    assert {"goal1/table/IDA", "goal1/s0/Expert"} <= names


def test_bad_calls_are_told(results: Path, tmp_path: Path) -> None:
    for arguments, said in (([], "neither"), (["--spec", "other", "--tensorboard", tmp_path / "x"], "spec in these results")):
        done = run_here("export", results, *arguments, columns=200)
        assert (done.exit_code, said in done.stderr) == (2, True), done.stderr
