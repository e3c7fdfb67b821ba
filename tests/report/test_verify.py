"""What a table cannot see: changed rows, cells of several versions, and a method that is not
installed any more.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from tests.commands import run_here
from tests.compare.two_runs import write_results
from tests.report.golden_store import STORE
from tests.run.harness import LED_BY, ROOT, group_is_gone, wait_until
from tests.view.conftest import brought
from wasp_cli.errors import WaspError
from wasp_cli.learning.device import training_device
from wasp_cli.run import verify
from wasp_cli.store.layout import Layout
from wasp_cli.store.provenance import processor
from wasp_cli.store.tables import EPISODES_FILE, write_episodes

pytestmark = pytest.mark.usefixtures("without_figures")
REPORT = ("--no-trained", "--paper", "none")


def test_changed_rows_are_named_by_verify_alone(tmp_path: Path) -> None:
    side = write_results(tmp_path / "results")
    assert run_here("report", side.layout.root, *REPORT, "--verify", columns=300).exit_code == 0
    key = side.cells[0].key
    path = side.layout.artifact("evaluate", key) / EPISODES_FILE
    table = pq.read_table(path)
    place = table.column_names.index("return")
    better = pc.add(table["return"], pa.scalar(5.0, table.schema.field(place).type))
    write_episodes(table.set_column(place, table.schema.field(place), better), path)
    manifest = side.layout.manifest("evaluate", key)
    record = json.loads(manifest.read_text(encoding="utf-8"))
    # as large as before, for all that a plan sees
    record["files"][EPISODES_FILE]["size"] = path.stat().st_size
    manifest.write_text(json.dumps(record), encoding="utf-8")
    told = run_here("report", side.layout.root, *REPORT, "--verify", columns=300, code=1)
    assert f"'{path}' has other bytes than were stored" in told.output
    assert "files are not those that were stored (1):" in told.output


def test_a_table_of_several_versions_says_so(tmp_path: Path) -> None:
    side = write_results(
        tmp_path / "results",
        provenance={
            "git": {"sha": "a" * 40, "dirty": False},
            "python": "3.11.7",
            "processor": "One",
        },
    )
    assert "same versions" not in run_here("report", side.layout.root, *REPORT, columns=300).output
    for key in (cell.key for cell in side.cells[:3]):
        path = side.layout.manifest("evaluate", key)
        record = json.loads(path.read_text(encoding="utf-8"))
        record["provenance"] |= {
            "versions": {"torch": "1.0.0"},
            "git": {"sha": "b" * 40, "dirty": False},
            "processor": "Another, AVX2",
        }
        path.write_text(json.dumps(record), encoding="utf-8")
    said = (
        "commit aaaaaaa (5 cells), bbbbbbb (3 cells); processor One (5 cells), Another (3 "
        "cells); torch 2.13.0 (5 cells), 1.0.0 (3 cells)."
    )
    told = run_here("report", side.layout.root, *REPORT, columns=300).output
    assert f"The cells were not computed with the same versions: {said}" in told


def test_a_table_that_is_cut_off_ends_with_1_and_a_linked_one_is_refused(tmp_path: Path) -> None:
    side = write_results(tmp_path / "results")
    cut, linked = (
        side.layout.artifact("evaluate", key) / EPISODES_FILE
        for key in (cell.key for cell in side.cells[:2])
    )
    cut.write_bytes(cut.read_bytes()[:-200])
    linked.symlink_to(linked.rename(tmp_path / "elsewhere"))
    told = run_here("report", side.layout.root, *REPORT, columns=300, code=1)
    assert "INCOMPLETE: 2 of 8 cells are missing (1 damaged, 1 refused)." in told.output
    assert f"part of the results cannot be read:\n  {cut} is damaged" in told.output


def test_cells_of_an_unknown_method_are_named_where_the_others_are_counted(tmp_path: Path) -> None:
    results, side = tmp_path / "results", write_results(tmp_path / "results")
    for record in ("spec.json", "plan.json"):
        path = side.layout.run(side.run_id) / record
        path.write_text(
            path.read_text(encoding="utf-8").replace('"wasp"', '"<b>held"'), encoding="utf-8"
        )
    told = run_here("report", results, *REPORT, columns=200, code=0)
    assert "none is left out" not in told.output
    assert "4 of 4 planned cells of what is installed here are finished" in told.output
    assert "held: not installed here; its 4 cells are left out." in told.output
    page = (results / "reports/tiny/report.md").read_text(encoding="utf-8")
    assert ("&lt;b>held: not installed here" in page, "<b>" in page) == (True, False)
    assert run_here("report", results, *REPORT, "--strict", columns=200).exit_code == 1
    assert (
        "<b>held: not installed here; its 4"
        in run_here("compare", results, results, "--strict", columns=200, code=1).output
    )


def test_cells_computed_again_import_no_module_of_their_folder_and_end_no_draw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = next(
        (brought(tmp_path, "goal1 s1 csa noisy=0.45") / "store").glob("evaluate/*/_manifest.json")
    )
    monkeypatch.chdir(tmp_path)
    Path("evil.py").write_text("open('imported', 'w').close()\n", encoding="utf-8")
    record = json.loads(manifest.read_text(encoding="utf-8")) | {"upstream": {}}

    def told(code: int, **changes: Any) -> str:
        manifest.write_text(json.dumps(record | changes), encoding="utf-8")
        return run_here("verify", tmp_path, "-j", "1", columns=300, code=code).output

    for change in ({"axes": {**record["axes"], "method": "evil:Evil"}}, {"task": "evil:Evil-v0"}):
        assert "a module of one's own" in told(2, **change)
    assert not Path("imported").exists()
    elsewhere = told(
        1,
        settings={**record["settings"], "gone": 1},
        provenance={**record["provenance"], "processor": "another"},
    )
    assert (
        "error: KeyError: 'gone'" in elsewhere,
        "computed on another processor" in elsewhere,
    ) == (True, False)
    devices = []
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr(
        "wasp_cli.stages.evaluate.EvaluateStage.run",
        lambda *_: devices.append(training_device().type),
    )
    for cuda in ({}, {"cuda": ["a GPU"]}):
        told(1, provenance={**record["provenance"], **cuda})
    assert devices == ["cpu", "cuda"]
    del record["provenance"]
    assert "error: KeyError: 'provenance'" in told(1)


def test_a_spec_lets_its_own_tasks_and_methods_run_as_it_declares_them() -> None:
    declared = {"id": "Pendulum-v1", "make": {"g": 9.0}}
    own = verify.OwnCode(
        {"swing": json.dumps(declared, sort_keys=True), "goal1": "null"},
        frozenset({"wasp", "mine:Mine"}),
    )

    def has(task: str, method: str, **settings: Any) -> bool:
        return own.has({"task": task, "axes": {"method": method}, "settings": settings})

    assert has("swing", "mine:Mine", environment={"make": {"g": 9.0}, "id": "Pendulum-v1"})
    assert has("goal1", "wasp")
    assert not has("swing", "wasp")
    assert not has("swing", "wasp", environment={**declared, "id": "theirs:Evil-v0"})
    assert not has("goal1", "wasp", environment={"id": "theirs:Evil-v0"})
    assert not has("swing", "theirs:Evil", environment=declared)
    assert not has("other", "wasp")


def test_a_draw_is_from_cells_of_this_kind_of_processor_where_there_are_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verify, "why_not", lambda *_: None)
    layout = Layout(brought(tmp_path, "goal1 s1 csa noisy=0.45", "goal1 s1 csa laggy=0.7"))
    first, second = sorted(layout.kind("evaluate").iterdir())
    for folder, name in ((first, f"{verify.kind(processor())}, AVX9"), (second, "another")):
        record = json.loads((folder / "_manifest.json").read_text(encoding="utf-8"))
        record["provenance"]["processor"] = name
        (folder / "_manifest.json").write_text(json.dumps(record), encoding="utf-8")
    assert verify.draw(layout, 30, 0) == verify.Drawn((first.name,), 2, 1, 0)
    assert verify.draw(layout, 30, 0, anywhere=True).cells == (first.name, second.name)


def test_what_differs_with_avx512_is_computed_once_more_with_avx2(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def again(_: Path, key: str, within: Path, beside: object) -> verify.Answer:
        with_avx2 = os.environ.get("ATEN_CPU_CAPABILITY") == "avx2"
        means = () if with_avx2 or key == "same" else (("cost", 1.0, 2.0),)
        return verify.Answer(
            key,
            key,
            ("cost",) if means else (),
            (),
            0.0,
            "A" if key != "elsewhere" else "B",
            "A, AVX512",
            means,
        )

    monkeypatch.setattr(verify, "again", again)
    monkeypatch.delenv("ATEN_CPU_CAPABILITY", raising=False)
    found = {
        answer.key: answer
        for answer in verify.verify(Layout(STORE), ["same", "other", "elsewhere"], 1)
    }
    assert {key: (bool(answer.differing), answer.with_avx2) for key, answer in found.items()} == {
        "same": (False, False),
        "elsewhere": (True, False),
        "other": (False, True),
    }


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_it_and_what_it_made_goes_if_it_can(tmp_path: Path, number: int) -> None:
    code = f"""if True:
        import os, pathlib, sys, time, wasp_cli.__main__
        from wasp_cli.run import verify
        os.environ[{LED_BY!r}] = str(os.getpid())
        verify.draw = lambda *_, **__: verify.Drawn(("a", "b"), 2, 0, 0)
        verify.again = lambda _, key, within, beside: ((within / key).touch(), time.sleep(600))
        sys.argv = ["wasp", "verify", {str(STORE)!r}, "-j", "2"]
        wasp_cli.__main__.main()
    """
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=ROOT,
        start_new_session=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    wait_until(lambda: len(list(tmp_path.glob("wasp-verify-*/?"))) == 2)
    process.send_signal(number)
    code = process.wait(60)
    wait_until(lambda: group_is_gone(process.pid), 60)
    assert (code, len(list(tmp_path.glob("wasp-verify-*")))) == (
        (130, 0) if number == signal.SIGTERM else (-number, 1)
    )


def test_a_killed_worker_ends_it_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify, "again", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    with pytest.raises(WaspError, match="a worker process was killed"):
        list(verify.verify(Layout(STORE), ["", ""], 2))


# `wasp export`: stored curves and the main table, read again by TensorBoard and Trackio themselves.


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(STORE, tmp_path_factory.mktemp("golden") / "results"))


def test_tensorboard_reads_curves_and_the_main_table(results: Path, tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run_here("export", results, "--tensorboard", tmp_path / "runs", columns=200, code=0)
    runs = {
        str(path.parent.relative_to(tmp_path / "runs/golden")): path.parent
        for path in (tmp_path / "runs").rglob("events.*")
    }
    assert {"goal1/table/IDA", "goal1/table/Human-only", "goal1/s0/Expert"} <= runs.keys()
    numbers = EventAccumulator(str(runs["goal1/table/IDA"]))
    numbers.Reload()
    from wasp_cli.notebook import open_results

    rows = open_results(results).table().to_pylist()
    (row,) = [row for row in rows if row["method"] == "IDA"]
    assert numbers.Scalars("cost")[0].value == pytest.approx(row["cost"])
    curve = EventAccumulator(str(runs["goal1/s0/Expert"]))
    curve.Reload()
    steps = [point.step for point in curve.Scalars("return")]
    assert len(steps) > 1
    assert steps == sorted(steps)
    assert (
        "is there already"
        in run_here(
            "export", results, "--tensorboard", tmp_path / "runs", columns=200, code=2
        ).stderr
    )


def test_trackio_reads_them_too(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the package reads it once, when it is imported
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path))
    import trackio

    assert (
        "Trackio metrics"
        not in run_here("export", results, "--trackio", tmp_path, columns=200, code=0).stdout
    )
    names = {run.name for run in trackio.Api().runs("golden")}
    assert {"goal1/table/IDA", "goal1/s0/Expert"} <= names


def test_bad_calls_are_told(results: Path, tmp_path: Path) -> None:
    for arguments, said in (
        ([], "nothing to write"),
        (["--spec", "other", "--tensorboard", tmp_path / "x"], "spec in these results"),
    ):
        assert said in run_here("export", results, *arguments, columns=200, code=2).stderr
