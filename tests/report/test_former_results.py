"""Results that commit a7e91f2 computed are read, reported and compared by this version.

`data/smoke-a7e91f2.tar.xz` is what that commit's `wasp run specs/smoke.yaml --set 'operators={laggy: {moderate: 0.7}}'` left in a results
folder, unchanged but for the names of folders of the machine, with the files of the evaluations and the branches only; and the
`table1.csv` that the commit wrote itself.
"""

from __future__ import annotations

import csv
import json
import shutil
import tarfile
from pathlib import Path

import pytest

from tests.commands import run_here

ARCHIVE = Path(__file__).parent / "data" / "smoke-a7e91f2.tar.xz"
METHODS = ("Human-only", "IDA", "Diffusion", "SafeRL-Res", "Safety filter", "WASP", "Expert")


@pytest.fixture(scope="module")
def former(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds the results folder `results` and the table `table1.csv`."""
    folder = tmp_path_factory.mktemp("former")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    return folder


def test_former_results_are_reported_with_the_table_of_their_own_version(former: Path, tmp_path: Path) -> None:
    done = run_here("report", former / "results", "--no-films", "--no-trained", "--strict", "--out", tmp_path, columns=160)
    assert (done.exit_code, done.stderr) == (0, "")
    shown = [line for line in done.stdout.partition("Main results")[2].splitlines() if any(name in line for name in METHODS)]
    assert len(shown) >= len(METHODS)
    assert "-1.13" in shown[0]  # Human-only's return
    here, there = (list(csv.DictReader(path.open())) for path in (tmp_path / "smoke" / "table1.csv", former / "table1.csv"))
    assert [{name: row[name] for name in there[0]} for row in here] == there
    assert {name: {row[name] for row in here} for name in here[0].keys() - there[0].keys()} == {"int_eff": {""}, "mag_eff": {""}}
    assert "Were the interventions necessary?" in done.stdout
    assert not (former / "results" / "reports").exists()


def test_former_results_are_compared(former: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    shutil.copytree(former / "results", again)
    alike = run_here("compare", former / "results", again, "--strict", columns=160)
    assert (alike.exit_code, alike.stderr) == (0, "")
    assert "7 cells: 7 the same; none differ by more than noise." in alike.stdout
    lost = next(iter(sorted((again / "store" / "evaluate").iterdir())))
    shutil.rmtree(lost)
    assert run_here("compare", former / "results", again, "--strict", columns=160).exit_code == 1


def test_a_former_decision_is_explained(former: Path) -> None:
    done = run_here(
        "explain", "goal1 s0 filter laggy=0.7", "-e", "0", "--json", "--results", former / "results", "--run", "smoke", columns=160
    )
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout)["who"]["label"] == "goal1 s0 filter laggy=0.7"
