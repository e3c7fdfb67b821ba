"""Disks that are full or read-only, files that are cut or flipped, records of other versions: a
clear state, which the next run repairs.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from safetensors.numpy import load_file

from tests.commands import run_here
from tests.report.golden_store import STORE
from tests.report.invented import invent, write_rows
from tests.run.harness import ROOT, as_undisturbed, prepared, run, wasp, written
from wasp_cli.cells.asked import asked_of, asked_of_grid
from wasp_cli.cells.runs import last_runs, read_run
from wasp_cli.cli.run import require_cells
from wasp_cli.errors import CellsFailed, StoreError
from wasp_cli.report.notes import FILE, invalid, notes_of
from wasp_cli.report.stats import read_frame
from wasp_cli.report.summarize import report_run
from wasp_cli.run.record import Journal
from wasp_cli.run.session import Session
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import read_json_lines
from wasp_cli.store.tables import EPISODES_FILE, SCHEMA, CellIdentity


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A file system of one megabyte; where none may be mounted, there is nothing to test with."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = shutil.which("mount") and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)],
        capture_output=True,
        check=False,
    )
    if not mounted or mounted.returncode:
        pytest.skip("may not mount a file system")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.parametrize("jobs", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_disk_that_fills_up_ends_nodes_and_a_run_with_room_repairs_it(
    jobs, fakes, small_spec, small_disk, tmp_path
):
    results = small_disk / "results"
    fakes.set(bytes=150_000)
    assert (
        "No space left on device"
        in wasp("run", small_spec, "--results", results, "-j", jobs, code=1).stderr
    )
    whole = list(results.glob("store/*/*/_manifest.json"))
    assert whole, "the disk had room for some"
    for manifest in whole:
        files = json.loads(manifest.read_text(encoding="utf-8"))["files"]
        assert all(
            (manifest.parent / name).stat().st_size == known["size"]
            for name, known in files.items()
        )
    subprocess.run(["mount", "-o", "remount,size=20m", str(small_disk)], check=True)
    assert (
        f"{len(whole)} computed before"
        in wasp("run", small_spec, "--results", results, "-j", jobs, code=0).stderr
    )
    shutil.copytree(results, tmp_path / "results")
    assert as_undisturbed(small_spec, tmp_path / "results")


def test_a_read_only_store_is_refused_to_runs_and_open_to_readers(fakes, small_spec, small_disk):
    results = small_disk / "results"
    run(small_spec, results)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    refused = run_here("run", small_spec, "--results", results, "-j", "0", columns=400, code=1)
    assert refused.stderr.startswith(
        f"error: cannot write results to '{results}': read-only file system"
    )
    for command in (
        ("plan", small_spec, "--results", results),
        ("status", results),
        ("show", "goal1 s0 expert", "--results", results),
    ):
        assert run_here(*command, columns=80).exit_code == 0
    subprocess.run(["mount", "-o", "remount,rw", str(small_disk)], check=True)
    assert run(small_spec, results).complete


def flip(path: Path, at: int = -5) -> None:
    """Change one byte, and neither size nor time."""
    state, data = path.stat(), bytearray(path.read_bytes())
    data[at] ^= 0x10
    path.write_bytes(data)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def test_weights_that_rotted_are_noticed_by_who_reads_them_and_computed_again(
    fakes, small_spec, results
):
    """safetensors has no checksum: flipped weights load without a word."""
    fakes.set(weights=True)
    run(small_spec, results)
    _, layout, plan = prepared(small_spec, results)
    world_model = next(step.node for step in plan.steps if step.node.kind == "world_model")
    reader = next(step.node for step in plan.steps if step.node.label == "goal1 s0 human noisy=0.2")
    weights = layout.artifact("world_model", world_model.key) / "weights.safetensors"
    before = load_file(weights)["w"].copy()
    flip(weights)
    assert not np.array_equal(load_file(weights)["w"], before)
    shutil.rmtree(layout.artifact("evaluate", reader.key))
    # A process of its own: this one has seen the whole file.
    done = wasp("run", small_spec, "--results", results, "-j", "0", code=1)
    assert "goal1 s0 human noisy=0.2: an input is damaged: '" in done.stderr
    assert "weights.safetensors' has other bytes than were stored" in done.stderr
    _, _, plan = prepared(small_spec, results)
    assert {(step.node.label, step.state) for step in plan.steps if step.runs} == {
        (world_model.label, "damaged"),
        (reader.label, "failed"),
    }
    assert run(small_spec, results).complete
    assert np.array_equal(load_file(weights)["w"], before)
    assert as_undisturbed(small_spec, results)


def test_a_damaged_cell_is_taken_out_of_use_and_computed_again(tmp_path, monkeypatch):
    """A flipped bit in a cell keeps its size, so only who reads the numbers can see it."""
    spec = written(tmp_path / "small.yaml")
    loaded, layout, plan = prepared(spec, tmp_path / "results")
    cell, node = plan.grid.cells[0]
    folder = staging_folder(layout, node.key)
    identity = CellIdentity(
        cell.task, cell.method, cell.variant, cell.operator, cell.value, cell.seed
    )
    write_rows(folder, identity, [invent(3, 2, 0.0, 0.1)])
    commit(layout, node.kind, node.key, folder, {"key": node.key, "kind": node.kind})
    path = layout.artifact(node.kind, node.key) / EPISODES_FILE
    column = pq.read_metadata(path).row_group(0).column(SCHEMA.get_field_index("return"))
    flip(path, column.data_page_offset + column.total_compressed_size - 1)
    grid = replace(plan.grid, cells=plan.grid.cells[:1])
    asked = asked_of_grid(layout, "", loaded.spec, grid)
    frame = read_frame(layout, asked.cells)
    assert [gap.damaged for gap in frame.missing] == [True]
    with pytest.raises(CellsFailed, match="1 cell cannot be read"):
        require_cells(frame.missing, layout)
    _, _, plan = prepared(spec, tmp_path / "results")
    (step,) = [step for step in plan.steps if step.node == node]
    assert step.state == "damaged"
    assert "is damaged or was cut off" in step.reason


KEY = sorted(path.name for path in (STORE / "store" / "evaluate").iterdir())[0]


@pytest.mark.parametrize("cut", [1, 30, 0])
def test_a_note_that_was_cut_is_an_error_and_takes_no_other_along(tmp_path, cut):
    layout = Layout(shutil.copytree(STORE, tmp_path / "results"))
    path, note = layout.root / FILE, ("note", KEY, "--results", layout.root)
    assert run_here(*note, "it is as it should be", columns=80).exit_code == 0
    room = path.stat().st_size + cut
    refused = subprocess.run(
        [sys.executable, "-B", "-m", "wasp_cli", *note, "-e", "0", "--invalid", "x"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (room, room)),
    )
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
            cut = (
                journal.failure is not None
                and "is not whole: file too large" in journal.failure.message
            )
            resource.setrlimit(
                resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
            )
            journal.write("third")
            os._exit(0 if cut and path.stat().st_size > room else 1)
        finally:
            os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert [event["event"] for event in read_json_lines(path)] == ["first", "third"]


def test_a_run_whose_journal_finds_no_room_computes_everything_and_ends_with_an_error(
    fakes, small_spec, results, monkeypatch
):
    monkeypatch.setattr(Layout, "journal", lambda self, run_id: Path("/dev/full"))
    summary = run(small_spec, results)
    assert summary.complete
    _, layout, plan = prepared(small_spec, results)
    assert not plan.to_run()
    with pytest.raises(StoreError, match="'/dev/full' is not whole: no space left on device"):
        Session(layout, "", plan, summary, {}).require_complete()


def test_results_of_another_version_and_of_an_absent_plugin_are_read(fakes, small_spec, results):
    run(small_spec, results)
    layout = Layout(results)
    (run_id,) = (run.run_id for run in last_runs(layout).runs.values())
    before = asked_of(read_run(layout, run_id))
    spec, plan = (layout.run(run_id) / name for name in ("spec.json", "plan.json"))
    document, planned = json.loads(spec.read_text()), json.loads(plan.read_text())
    document["blend"] = {"share": 0.5}  # the section of a plugin
    document["wasp"]["braveness"] = 2  # a field of another version
    document["wasp"]["operator_model"] = "oracle"  # a value of another version
    document["methods"] += ["blend", "mix"]
    document["operators"]["sleepy"] = {"mild": 1.0}
    spec.write_text(json.dumps(document))
    cell = next(cell for cell in planned["cells"] if cell["method"] == "human")
    planned["cells"] += [
        {**cell, "method": "blend", "key": "0" * 20},
        {**cell, "operator": "sleepy", "key": "1" * 20},
    ]
    plan.write_text(json.dumps(planned))
    after = asked_of(read_run(layout, run_id))
    assert (after.cells, after.parts) == (before.cells, before.parts)
    assert after.spec == before.spec
    told = "\n".join(after.unknown)
    for name in (
        "`blend`",
        "`wasp.braveness`",
        "`wasp.operator_model`",
        "`methods: blend`",
        "`methods: mix`",
        "`operators.sleepy`",
    ):
        assert name in told
    assert after.absent == (
        "blend: not installed here; its cell is left out.",
        "sleepy: not installed here; its cell is left out.",
    )
    report = report_run(after)
    assert {*after.unknown, *after.absent} <= set(report.facts)
