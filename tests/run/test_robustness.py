"""What the surroundings of a run can do to it: folders that cannot be read, readers that go away, plugins that break."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.run.harness import ROOT, prepared
from wasp_cli.errors import StoreError
from wasp_cli.run.record import new_run, results_of
from wasp_cli.run.runner import job_of
from wasp_cli.run.worker import execute


def test_results_that_cannot_be_read_are_refused(tmp_path, monkeypatch):
    with pytest.raises(StoreError, match="file name too long"):
        results_of(tmp_path / ("x" * 300))

    def forbid(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("wasp_cli.run.record.os.scandir", forbid)
    with pytest.raises(StoreError, match="permission denied"):
        results_of(tmp_path)


def test_changed_source_explains_a_failure(fakes, small_spec, tmp_path):
    fakes.set(behave={"goal1": "raise"})
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    run_id = new_run(layout, loaded, plan)
    layout.journal(run_id).touch()
    job = job_of(layout, run_id, plan.to_run()[0])
    result = execute(replace(job, sources={**job.sources, "wasp_cli.config": "0" * 12}), own_process=False)
    assert result.message == "the source changed during the run: wasp_cli.config"
    assert "ZeroDivisionError" in Path(result.log).read_text(encoding="utf-8")


def closed_pipe() -> int:
    reader, writer = os.pipe()
    os.close(reader)
    return writer


def wasp(*arguments: str | Path, stdout: int, program: tuple[str, ...] = ("-m", "wasp_cli")) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *program, *map(str, arguments)]
    try:
        return subprocess.run(command, cwd=ROOT, stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=600, check=False)
    finally:
        os.close(stdout)


def test_a_reader_that_goes_away_does_not_change_how_a_run_ends(fakes, small_spec, tmp_path):
    fakes.set(behave={"s1 critics": "refuse"})
    arguments = ("run", small_spec, "--results", tmp_path / "results", "-j", "0")
    done = wasp(*arguments, stdout=closed_pipe(), program=("tests/run/fake_wasp.py",))
    assert done.returncode == 1
    assert "1 failed:" in done.stderr
    assert "Traceback" not in done.stderr
    assert "BrokenPipe" not in done.stderr
