"""`wasp gc`: what no spec reaches goes, and nothing that somebody reads."""

import hashlib
import json
import os
import re
import shutil
import signal
import tarfile
import time
from collections import Counter
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from tests.commands import run_here
from tests.run.harness import faked, finished, keys_of, run, start, wait_until, written
from tests.run.recorded import key, planned, process, write_run
from wasp_cli.cells.runs import run_ids
from wasp_cli.cli.options import SelectedSpec
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.export import hub
from wasp_cli.export.hub import require_archive, write_archive
from wasp_cli.notebook import open_results
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.plan import plan_against
from wasp_cli.report.notes import Note, add_note
from wasp_cli.run import reach
from wasp_cli.run.reach import remove_unreached, unreached
from wasp_cli.run.record import _new_folder, new_run
from wasp_cli.run.session import RunOptions, run_sweep
from wasp_cli.spec.load import read_sweep
from wasp_cli.store.artifact import commit, staging_folder, sweep
from wasp_cli.store.layout import SESSION_FILE, Layout
from wasp_cli.store.lock import held, is_held
from wasp_cli.store.plain import read_json_lines
from wasp_cli.store.records import write_record


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("both")
    with faked(folder):
        run(written(folder / "small.yaml"), folder / "results")
        run(written(folder / "other.yaml", "seeds: [0, 1]", "seeds: [1, 7]"), folder / "results")
    return folder / "results"


@pytest.fixture
def results(both, fakes, tmp_path) -> Path:
    """Of both, of which the other is the newest."""
    return shutil.copytree(both, tmp_path / "results")


def collect(results: Path, *options: str | Path) -> str:
    return run_here("gc", results, *options, columns=80, code=0).stdout


def table(text: str) -> dict[str, tuple[int, str]]:
    """What can go: its count and its size, as they are printed."""
    rows = re.findall(r"^ *(\S.*?) {2,}(\d+) {2,}(\d\S* \w+) *$", text, re.MULTILINE)
    return {what: (int(count), size) for what, count, size in rows}


def test_what_the_newest_run_of_a_spec_reaches_stays(
    fakes, small_spec, other_spec, results, tmp_path
):
    old, new = keys_of(small_spec, results), keys_of(other_spec, results)
    assert finished(results) == old | new
    assert "nothing was removed" in collect(results)
    shown = table(collect(results, "--dry-run"))
    assert finished(results) == old | new
    unwanted = Counter(
        path.parent.name for path in results.glob("store/*/*") if path.name not in new
    )
    assert {what: count for what, (count, _) in shown.items() if what in unwanted} == unwanted
    (results / "tmp").rmdir()
    assert "removed" in collect(results, "--yes").splitlines()[-1]
    assert finished(results) == new
    assert not list((results / "tmp").iterdir())
    assert not list((results / "locks").glob("[0-9a-f]*"))
    assert run(other_spec, results).done == 0
    assert run(small_spec, results).done == len(old - new)


def test_a_restricted_run_displaces_no_whole_one(fakes, other_spec, results):
    layout, whole = Layout(results), keys_of(other_spec, results)
    for restriction in ({"limit": 1}, {"method": ["human"]}):
        part = SelectedSpec(spec=other_spec, **restriction).load()
        new_run(layout, part, plan_against(lay_out(part.spec), layout))
    collect(results, "--yes")
    assert finished(results) == whole


def test_a_narrowed_sweep_displaces_no_whole_one(fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    for methods in ((), ("wasp",)):
        run_sweep(
            read_sweep(small_spec, "wasp.tau_c=0.3,0.5", methods), results, RunOptions(jobs=0)
        )
    whole = finished(results)
    for folder in (results / "runs").iterdir():
        os.utime(folder, (0, 0))  # or the runs of the values might still begin
    collect(results, "--yes")
    assert finished(results) == whole


def test_upstream_of_what_is_reached_stays_though_no_plan_names_it(fakes, small_spec, tmp_path):
    """As after an update: the plan's keys changed, but a kept artifact was computed from one of
    before.
    """
    results = tmp_path / "results"
    run(small_spec, results)
    layout = Layout(results)
    (run_id,) = run_ids(layout)
    plan = json.loads((layout.run(run_id) / "plan.json").read_text())
    plan["nodes"] = [node for node in plan["nodes"] if node["kind"] == "evaluate"]
    write_record(layout.run(run_id) / "plan.json", plan)
    before = finished(results)
    diagnostics = {path.name for path in results.glob("store/diagnostics/*")}
    collect(results, "--yes")
    assert diagnostics
    assert before - finished(results) == diagnostics  # no evaluation reads them


def stop(process: Any) -> None:
    process.send_signal(signal.SIGSTOP)
    # a signal takes its time
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)


def test_a_run_that_goes_on_loses_nothing(fakes, small_spec, other_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(seconds=0.1)
    process = start("run", small_spec, "--results", results, "-j", "0")
    wait_until(lambda: len(finished(results)) >= 5)
    (journal,) = results.glob("runs/*/journal.jsonl")
    shared = keys_of(small_spec, results) & keys_of(other_spec, results)
    stop(process)  # or it could end before gc looks, and what it computed could go
    # stopped there, it would keep the other run waiting for ever
    while any(is_held(Layout(results).lock(key)) for key in shared):
        process.send_signal(signal.SIGCONT)
        time.sleep(0.05)
        stop(process)
    fakes.set(seconds=0.0)
    run(other_spec, results)  # newer, and of the same name
    looked = 0
    while (
        looked < 4
        and process.poll() is None
        and read_json_lines(journal)[-1]["event"] != "run ended"
    ):
        before = finished(results)
        collect(results, "--yes", "--runs")
        assert before <= finished(results)
        looked += 1
        process.send_signal(signal.SIGCONT)
        time.sleep(0.1)
        stop(process)
    process.send_signal(signal.SIGCONT)
    assert looked
    output = process.communicate()
    assert process.returncode == 0, output
    assert keys_of(small_spec, results) <= finished(results)


def test_a_run_that_died_holds_nothing(fakes, small_spec, other_spec, results, tmp_path):
    layout = Layout(results)
    run_id = run_ids(layout)[-1]
    journal = layout.run(run_id) / "journal.jsonl"
    events = [event for event in read_json_lines(journal) if event["event"] != "run ended"]
    write_record(layout.reporting(run_id), {"host": "elsewhere"})  # its report was to follow
    for facts, stays in (
        (process(os.getpid()), True),
        ({**process(os.getpid()), "boot": "another"}, False),
    ):
        events[0] |= {**facts, "locked": False}
        journal.write_text("".join(json.dumps(event) + "\n" for event in events))
        collect(results, "--yes")
        assert (keys_of(small_spec, results) <= finished(results)) == stays


def test_what_is_being_computed_stays(fakes, small_spec, other_spec, results, tmp_path):
    """By a run that this machine cannot see: its locks tell."""
    layout = Layout(results)
    evaluation = next(
        path
        for path in sorted(results.glob("store/evaluate/*"))
        if path.name not in keys_of(other_spec, results)
    )
    reads = set(json.loads((evaluation / "_manifest.json").read_text())["upstream"].values())
    with held(layout.lock(evaluation.name), lambda: None):
        collect(results, "--yes")
        assert is_held(layout.lock(evaluation.name))
    assert evaluation.name in finished(results)
    assert reads <= finished(results)
    collect(results, "--yes")
    assert evaluation.name not in finished(results)


def test_runs_go_only_when_asked(results, tmp_path):
    run(written(tmp_path / "named.yaml", "name: small", "name: named"), results)
    layout = Layout(results)
    named, newest, _ = before = run_ids(layout)
    collect(results, "--yes")
    assert run_ids(layout) == before
    collect(results, "--yes", "--runs")
    assert run_ids(layout) == [named, newest]


def test_what_runs_leave_behind(fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    fakes.set(behave={"s0 ida_q": "refuse"})
    run(small_spec, results)
    layout = Layout(results)
    (failed,) = (path.stem for path in layout.failures.iterdir())
    done, unreached_key, busy = sorted(finished(results))[0], "ab" * 10, "cd" * 10
    for name in (done, failed, unreached_key, busy):
        layout.work(name).mkdir(exist_ok=True)
        (layout.work(name) / "checkpoint").write_bytes(b"x" * 1000)
    write_record(layout.failure(unreached_key), {"message": "of an older version"})
    left, written = staging_folder(layout, unreached_key), staging_folder(layout, busy)
    with held(layout.lock(busy), lambda: None):
        shown = table(collect(results, "--yes"))
        assert sorted(path.name for path in layout.works.iterdir()) == sorted([failed, busy])
    assert [path.stem for path in layout.failures.iterdir()] == [failed]
    assert (left.exists(), written.exists()) == (False, True)
    assert sorted(path.name for path in layout.locks.iterdir()) == sorted([busy, "planning"])
    assert shown["work of nodes"] == (2, "2.0 kB")
    assert [shown[what][0] for what in ("records of failures", "left in tmp")] == [1, 1]


def test_nothing_goes_where_a_plan_does_not_read(fakes, small_spec, other_spec, results, tmp_path):
    layout = Layout(results)
    run_id = run_ids(layout)[-1]
    before, plan = finished(results), layout.run(run_id) / "plan.json"
    whole = json.loads(plan.read_text())
    for text in (
        "{",
        json.dumps({**whole, "nodes": [*whole["nodes"], {"key": "of another form"}]}),
    ):
        plan.write_text(text)
        assert (
            "what it needs is unknown"
            in run_here("gc", results, "--yes", columns=80, code=1).stderr
        )
    plan.unlink()
    assert "is being planned" in run_here("gc", results, "--yes", columns=80).stderr
    assert finished(results) == before
    with pytest.raises(KeyboardInterrupt), _new_folder(layout, "small", False):
        raise KeyboardInterrupt  # what it leaves does not block gc
    assert run_ids(layout)[-1] == run_id
    os.utime(layout.run(run_id), (0, 0))  # killed while it began, long ago
    collect(results, "--yes")
    assert finished(results) == keys_of(other_spec, results)


def test_a_run_that_begins_while_someone_thinks_about_it_keeps_what_it_found(
    fakes, small_spec, other_spec, results, tmp_path
):
    layout = Layout(results)
    shown = unreached(layout, set(), runs=False, before=None)
    fakes.set(free=len(fakes.executions()))  # it waits at its first node
    spec = written(small_spec.with_name("more.yaml"), "seeds: [0, 1]", "seeds: [0, 9]")
    process = start("run", spec, "--results", results, "-j", "1")
    try:
        wait_until(lambda: len(run_ids(layout)) == 3 and any(results.glob("runs/*/running/*.json")))
        remove_unreached(layout, set(), shown, runs=False, before=None)
        assert keys_of(small_spec, results) & keys_of(spec, results) <= finished(results)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=600)


def test_a_removal_that_is_killed_leaves_nothing_half(
    fakes, small_spec, other_spec, results, tmp_path, monkeypatch
):
    layout = Layout(results)
    whole = {path.name: len(list(path.iterdir())) for path in results.glob("store/*/*")}
    with monkeypatch.context() as patch:
        patch.setattr(reach, "discard", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            remove_unreached(
                layout,
                set(),
                unreached(layout, set(), runs=False, before=None),
                runs=False,
                before=None,
            )
    left = {path.name: len(list(path.iterdir())) for path in results.glob("store/*/*")}
    assert len(left) == len(whole) - 1
    assert left.items() <= whole.items()
    assert sweep(layout) == 1
    assert not list(layout.tmp.iterdir())


# `wasp publish --archive`: a folder for an archive, whose sums hold, and from which rows are read
# again.


PUBLISHED = Path(__file__).parents[2] / "results" / "published"
KEY = "ab95264a06906dcda61e"  # race1 s1 wasp laggy=0.7


@pytest.fixture
def target(tmp_path):
    shutil.copytree(PUBLISHED / "store/evaluate" / KEY, tmp_path / "published/store/evaluate" / KEY)
    (tmp_path / "published/reports/mine").mkdir(parents=True)
    (tmp_path / "published/reports/mine/report.md").write_text("# Report: mine\n")
    (tmp_path / "published/private").symlink_to("/etc/hostname")
    return Layout(tmp_path / "published")


def test_an_archive_has_sums_that_hold_our_licence_and_a_card_and_is_read_again(
    target, tmp_path, monkeypatch
):
    (tmp_path / "LICENSE").write_text("of another package")
    # as in a folder of installed packages
    monkeypatch.setattr(hub, "__file__", str(tmp_path / "wasp_cli/export/hub.py"))
    file = tmp_path / "mine-1.0.tar.gz"
    count = write_archive(target, "mine", file)
    with tarfile.open(file) as archive:
        assert len(archive.getnames()) == count
        # Python 3.11 has filters from 3.11.4 on
        archive.extraction_filter = getattr(tarfile, "data_filter", None)
        archive.extractall(tmp_path / "unpacked")
    root = tmp_path / "unpacked/mine-1.0"
    lines = (root / "SHA256SUMS").read_text().splitlines()
    assert {line.split("  ")[1] for line in lines} | {"SHA256SUMS"} == {
        str(p.relative_to(root)) for p in root.rglob("*") if p.is_file()
    }
    for line in lines:
        digest, name = line.split("  ")
        assert hashlib.sha256((root / name).read_bytes()).hexdigest() == digest
    card = (root / "README.md").read_text()
    assert card.startswith("---\nlicense: apache-2.0\n")
    assert "| evaluate | 1 | race1 |" in card
    assert "wasp verify" not in card, "it has no models"
    assert "Apache License" in (root / "LICENSE").read_text()
    assert not (root / "private").exists()
    assert open_results(root).episodes().num_rows == 30


def test_the_same_folder_gives_the_same_bytes_and_nothing_is_overwritten_or_cut_off(
    target, tmp_path, monkeypatch
):
    first, second = tmp_path / "a/mine.tar.gz", tmp_path / "b/mine.tar.gz"
    for file in (first, second):
        file.parent.mkdir()
        write_archive(target, "mine", file)
    assert first.read_bytes() == second.read_bytes()
    for name in ("mine.tar.gz", "mine.zip"):
        with pytest.raises(UsageError):
            require_archive(tmp_path / "a" / name)
    with pytest.raises(StoreError):
        write_archive(Layout(tmp_path / "none"), "mine", tmp_path / "c.tar.gz")
    monkeypatch.setattr("gzip.compress", lambda *_, **__: (tmp_path / "none").stat())
    with pytest.raises(FileNotFoundError):
        write_archive(target, "mine", tmp_path / "c.tar.gz")
    assert not (tmp_path / "c.tar.gz").exists()


# `wasp gc` and what nobody can compute again: what a person drove, what was fitted to it, and what
# somebody noted.


LONG_AGO = time.time() - 7200
MODEL, ALONE, OTHER, CLONE, CLONED, BRANCHES, NEWEST, BEGUN, BEGUN_MODEL, NOTED, UNWANTED = range(
    1, 12
)


def stored(
    layout: Layout,
    kind: str,
    number: int,
    reads: int | None = None,
    variant: str = "noisy",
    *,
    session: bool = False,
) -> Path:
    staging = staging_folder(layout, key(number))
    (staging / "rows").write_bytes(b"rows")
    if session:
        write_record(staging / SESSION_FILE, {"number": 1})
    upstream = {} if reads is None else {"read": key(reads)}
    manifest = {
        "kind": kind,
        "key": key(number),
        "label": f"n{number}",
        "axes": {"operator": variant},
        "upstream": upstream,
    }
    return commit(layout, kind, key(number), staging, manifest)


def begin(layout: Layout, number: int) -> None:
    write_record(layout.work(key(number)) / SESSION_FILE, {"number": 2})
    (layout.work(key(number)) / "episodes.parquet").write_bytes(b"two episodes")


def drove(layout: Layout, second: int, *nodes: dict[str, Any]) -> str:
    run_id = f"20260501-1200{second:02d}-drive-0001"
    write_run(layout, run_id, list(nodes), spec="drive")
    os.utime(layout.run(run_id), (LONG_AGO, LONG_AGO))
    return run_id


def left(layout: Layout) -> set[int]:
    return {int(path.name, 16) for path in layout.store.glob("*/*")}


def test_the_next_participant_displaces_nobody(layout):
    stored(layout, "world_model", MODEL)
    stored(layout, "evaluate", ALONE, MODEL, "person", session=True)
    damaged = stored(layout, "evaluate", OTHER, MODEL, "person", session=True)
    (damaged / "_manifest.json").write_text("{")
    stored(layout, "clone", CLONE, ALONE, "person")
    stored(layout, "evaluate", CLONED, CLONE, "cloned")
    stored(layout, "counterfactual", BRANCHES, CLONED, "cloned")
    stored(layout, "evaluate", NEWEST, MODEL, "person", session=True)
    stored(layout, "world_model", BEGUN_MODEL)
    stored(layout, "evaluate", UNWANTED)
    begin(layout, BEGUN)
    begun = [planned(BEGUN_MODEL, "model", "cached"), planned(BEGUN, "begun", needs=[BEGUN_MODEL])]
    first = drove(layout, 1, planned(ALONE, "alone"))
    second = drove(layout, 2, *begun)
    nobody = drove(layout, 3, planned(UNWANTED, "a grid of the same name", "cached"))
    newest = drove(layout, 4, planned(NEWEST, "newest"))
    collect(layout.root, "--yes", "--runs")
    assert left(layout) == {MODEL, ALONE, OTHER, CLONE, CLONED, BRANCHES, NEWEST, BEGUN_MODEL}
    assert (layout.work(key(BEGUN)) / "episodes.parquet").read_bytes() == b"two episodes"
    assert {path.name for path in layout.runs.iterdir()} == {first, second, newest} != {nobody}


def test_what_a_note_is_about_stays(layout):
    stored(layout, "world_model", MODEL)
    stored(layout, "evaluate", NOTED, MODEL)
    stored(layout, "evaluate", UNWANTED, MODEL)
    add_note(layout, Note(key(NOTED), "noted", 3, "it starts within a hazard", "invalid"))
    collect(layout.root, "--yes", "--runs")
    assert left(layout) == {MODEL, NOTED}
    (layout.root / "notes.jsonl").unlink()
    (layout.root / "notes.jsonl").mkdir()
    assert (
        "the notes cannot be read"
        in run_here("gc", layout.root, "--yes", columns=80, code=1).stderr
    )
    assert left(layout) == {MODEL, NOTED}
