"""`wasp drive --check` and a session that nobody drove: neither hides what was driven before."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.drive.conftest import wanted
from wasp_cli.drive.check import Habits
from wasp_cli.drive.command import drive_session
from wasp_cli.report.provenance import last_runs
from wasp_cli.run.record import read_run
from wasp_cli.store.layout import Layout


@pytest.fixture(scope="module")
def driven(imported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One episode that a script drove alone."""
    results = tmp_path_factory.mktemp("check") / "results"
    shutil.copytree(imported, results)
    asked = wanted(results, simulated=True)
    session = asked.prepared()
    drive_session(session, 0, open_browser=False, scripted=Habits(0))
    asked.record(session)
    return results


def reported(results: Path) -> set[str]:
    layout = Layout(results)
    return {key for _, key in read_run(layout, last_runs(layout)[0]["drive"]).cells}


def files(results: Path) -> set[Path]:
    return {path.relative_to(results) for path in results.rglob("*")}


def test_a_check_leaves_nothing_behind(driven: Path) -> None:
    before, there = reported(driven), files(driven)
    done = run_here("drive", "goal1", "--method", "wasp", "--check", "--speed", "4", "--results", driven, columns=80)
    assert done.exit_code in (0, 1), done.output  # 1: a busy machine was late
    assert "99th percentile" in done.stdout
    assert "…" not in done.stdout
    assert all(len(line.rstrip()) <= 80 for line in done.stdout.splitlines()[:6])
    assert files(driven) == there
    assert reported(driven) == before
    assert before <= {path.name for path in (driven / "store" / "evaluate").iterdir()}
