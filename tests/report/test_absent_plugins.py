"""A method that is not installed any more is named as missing, wherever its cells were planned."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.commands import run_here
from tests.compare.two_runs import write_results

REPORT = ("--no-films", "--no-trained", "--paper", "none")


def without(folder: Path, method: str, **changes: Any) -> Path:
    """Results of which one method is unknown now."""
    side = write_results(folder, **changes)
    for record in ("spec.json", "plan.json"):
        path = side.layout.run(side.run_id) / record
        path.write_text(path.read_text(encoding="utf-8").replace(f'"{method}"', '"held"'), encoding="utf-8")
    return folder


def test_its_cells_are_named_where_the_others_are_counted(tmp_path: Path) -> None:
    results = without(tmp_path / "results", "wasp")
    told = run_here("report", results, *REPORT, columns=200)
    assert told.exit_code == 0, told.output
    assert "none is left out" not in told.output
    assert "4 of 4 planned cells of what is installed here are finished" in told.output
    assert "held: not installed here; its 4 cells are left out." in told.output
    assert "held: not installed here" in (results / "reports/tiny/report.md").read_text(encoding="utf-8")
    assert run_here("report", results, *REPORT, "--strict", columns=200).exit_code == 1


def test_a_run_of_it_alone_still_has_a_report(tmp_path: Path) -> None:
    results = without(tmp_path / "results", "wasp", methods=["wasp"], stages=["counterfactual"])
    told = run_here("report", results, *REPORT, columns=200)
    assert told.exit_code == 0, told.output
    assert "held: not installed here; its 4 cells are left out." in told.output
