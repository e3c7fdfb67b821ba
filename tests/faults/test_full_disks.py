"""A disk that takes only a part of a line: whoever wrote it is told, and the next line stays whole."""

import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.report.golden_store import STORE
from tests.run.harness import ROOT, prepared, run
from wasp_cli.errors import StoreError
from wasp_cli.report.notes import FILE, invalid, notes_of
from wasp_cli.run.record import Journal
from wasp_cli.run.session import Session
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import read_json_lines

KEY = sorted(path.name for path in (STORE / "store" / "evaluate").iterdir())[0]


@pytest.mark.parametrize("cut", [1, 30, 0])
def test_a_note_that_was_cut_is_an_error_and_takes_no_other_along(tmp_path, cut):
    layout = Layout(shutil.copytree(STORE, tmp_path / "results"))
    path, note = layout.root / FILE, ("note", KEY, "--results", layout.root)
    assert run_here(*note, "it is as it should be", columns=80).exit_code == 0
    room = path.stat().st_size + cut
    refused = subprocess.run(
        [sys.executable, "-B", "-m", "wasp_cli", *note, "-e", "0", "--invalid", "x"], cwd=ROOT, capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (room, room)),
    )  # fmt: skip
    assert refused.returncode == 1, refused.stdout + refused.stderr
    assert f"the note cannot be written to '{path}'" in refused.stderr
    assert "file too large" in refused.stderr
    assert "Traceback" not in refused.stderr
    assert path.stat().st_size == room
    assert run_here(*note, "-e", "1", "--invalid", "y", columns=80).exit_code == 0
    assert [each.text for each in notes_of(layout)] == ["it is as it should be", "y"]
    assert list(invalid(notes_of(layout))) == [(KEY, 1)]


def test_a_journal_goes_on_after_an_event_that_was_cut_and_says_so(tmp_path):
    path = tmp_path / "journal.jsonl"
    child = os.fork()
    if not child:
        try:
            journal = Journal(path)
            journal.write("first")
            room = path.stat().st_size + 20
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
            journal.write("second")
            cut = journal.failure is not None and "is not whole: file too large" in journal.failure.message
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            journal.write("third")
            os._exit(0 if cut and path.stat().st_size > room else 1)
        finally:
            os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert [event["event"] for event in read_json_lines(path)] == ["first", "third"]


def test_a_run_whose_journal_finds_no_room_computes_everything_and_ends_with_an_error(fakes, small_spec, tmp_path, monkeypatch):
    monkeypatch.setattr(Layout, "journal", lambda self, run_id: Path("/dev/full"))
    results = tmp_path / "results"
    summary = run(small_spec, results)
    assert summary.complete
    _, layout, plan = prepared(small_spec, results)
    assert not plan.to_run()
    with pytest.raises(StoreError, match="'/dev/full' is not whole: no space left on device"):
        Session(layout, "", plan, summary, {}).require_complete()
