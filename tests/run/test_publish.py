"""`wasp publish` over fake stages: what it copies, what it refuses, and that nothing of a
machine goes along.
"""

import json
import math
import platform
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.commands import run_here
from tests.run.harness import faked, run, wait_until, written
from tests.run.harness import finished as keys
from tests.run.recorded import dead_pid, process
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.plan import plan_against
from wasp_cli.run import publish as publish_module
from wasp_cli.run.process import this_process
from wasp_cli.run.publish import PUBLIC, carry_publication
from wasp_cli.run.record import new_run
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.spec.load import limited, load
from wasp_cli.store.artifact import corruption, file_digest, read_manifest, sweep
from wasp_cli.store.layout import Layout
from wasp_cli.store.provenance import provenance
from wasp_cli.store.records import write_record
from wasp_cli.store.slim import Slimming

HOST = "a-machine-of-mine"


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Iterator[Path]:
    """A results folder in which the spec has been run, on a machine of that name, with a report."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch, faked(folder):
        patch.setattr(platform, "node", lambda: HOST)
        provenance.cache_clear()
        run(written(folder / "small.yaml"), folder / "results")
        report = Layout(folder / "results").reports("small")
        report.mkdir(parents=True)
        (report / "report.md").write_text("# Report: small\n")
        yield folder / "results"
    provenance.cache_clear()


@pytest.fixture
def results(finished, fakes, tmp_path) -> Path:
    return shutil.copytree(finished, tmp_path / "results")


def publish(spec: Path, results: Path, *options: str | Path, code: int = 0) -> str:
    return run_here("publish", spec, "--results", results, *options, columns=200, code=code).output


def tree(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_everything_small_is_published_and_nothing_else_is_written(results, small_spec):
    shutil.rmtree(results / "locks")
    told = publish(small_spec, results, "--dry-run")
    assert not (results / "locks").exists(), "it only shows"
    for name in ("mine.tgz", "...tar.gz", ".tar.gz", "missing/mine.tar.gz"):
        publish(small_spec, results, "--archive", results / name, code=2)
    assert not (results / "published").exists()
    assert publish(small_spec, results).startswith(told)
    layer = Layout(results / "published")
    assert keys(layer.root) == keys(results)
    assert {path.name for path in layer.root.iterdir()} == {"store", "reports"}
    assert (layer.reports("small") / "report.md").read_text() == "# Report: small\n"
    rows = {line.split()[0]: line.split()[1:] for line in told.splitlines() if line.strip()}
    assert rows["evaluate"][0] == str(len(list(results.glob("store/evaluate/*"))))
    assert rows["total"][0] == str(len(keys(results)) + 1)
    for path in layer.store.glob("*/*"):
        assert corruption(layer, path.parent.name, path.name) is None


def test_manifests_say_where_results_came_from_and_name_nobody(results, finished, small_spec):
    for path in results.glob("store/evaluate/*/_manifest.json"):
        path.write_text(
            path.read_text().replace('"provenance": {', '"provenance": {"cuda": ["a GPU"],')
        )
    publish(small_spec, results)
    layout, layer = Layout(results), Layout(results / "published")
    for path in layer.store.glob("*/*"):
        ours, theirs = (
            read_manifest(each, path.parent.name, path.name) for each in (layout, layer)
        )
        assert ours["provenance"]["host"] == HOST
        assert set(theirs["provenance"]) == set(ours["provenance"]) & set(PUBLIC)
        assert all(
            theirs["provenance"].get(name) == ours["provenance"].get(name)
            for name in ("git", "cuda")
        )
        assert {**theirs, "provenance": 0} == {
            **ours,
            "provenance": 0,
            "recipe": theirs["recipe"],
            "behind": theirs["behind"],
        }
        assert set(ours["upstream"].values()) <= set(theirs["behind"].values())
        text = (path / "_manifest.json").read_text()
        assert not any(name in text for name in (HOST, str(results), str(finished)))


def test_a_report_of_other_cells_is_left_out(results, small_spec):
    layout, part = Layout(results), limited(load(small_spec), 1)
    new_run(layout, part, plan_against(lay_out(part.spec), layout))
    assert "left out: the report" in publish(small_spec, results)
    assert not (results / "published/reports").exists()


def test_a_report_from_before_an_interrupted_run_is_left_out_until_wasp_report_has_written_its_own(
    results, small_spec
):
    layout, whole = Layout(results), load(small_spec)
    run_id = new_run(layout, whole, plan_against(lay_out(whole.spec), layout), reports=True)
    for record, there in ((this_process(), True), (process(dead_pid()), False)):
        write_record(layout.reporting(run_id), record)
        assert "left out: the report" in publish(small_spec, results, "--dry-run")
        run_here("report", results, "--no-trained", columns=200)
        assert layout.reporting(run_id).exists() == there


def test_where_it_may_not_write_nothing_is_published_and_nothing_said(
    results, small_spec, tmp_path
):
    shutil.rmtree(results / "reports")
    assert "published in" not in publish(small_spec, results, "--largest", "0")
    assert "is no folder of published results" in publish(
        small_spec, results, "--to", results, code=2
    )
    (tmp_path / "elsewhere").mkdir()
    (results / "published").symlink_to(tmp_path / "elsewhere")
    publish(small_spec, results, code=1)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_what_is_damaged_in_the_layer_is_published_anew(results, small_spec):
    publish(small_spec, results)
    first, second, third = sorted((results / "published/store").glob("evaluate/*"))[:3]
    (first / "data.bin").write_bytes(bytes((first / "data.bin").stat().st_size))
    (second / "data.bin").unlink()
    (third / "_manifest.json").write_text("{")
    publish(small_spec, results)
    layer = Layout(results / "published")
    for path in (first, second, third):
        assert corruption(layer, "evaluate", path.name) is None
        assert {each.name for each in path.iterdir()} == {
            each.name for each in (results / "store/evaluate" / path.name).iterdir()
        }
    assert not layer.tmp.exists()


def test_a_copy_with_fewer_steps_stays_and_is_told(results, small_spec):
    publish(small_spec, results)
    manifest = sorted((results / "published/store").glob("evaluate/*/_manifest.json"))[0]
    manifest.write_text(
        json.dumps(
            {
                **json.loads(manifest.read_text()),
                "slim": {"_steps.pq": {"left_out": "all but the first"}},
            }
        )
    )
    for options, told in ((), True), (("--steps", "2"), True), (("--steps", "1"), False):
        assert (
            "1 of the cells there have fewer steps and stay as they are"
            in publish(small_spec, results, *options)
        ) == told


@pytest.mark.parametrize("harm", ["gone", "other size", "other bytes"])
def test_what_is_not_there_or_not_whole_is_refused(harm, results, small_spec):
    victim = sorted(results.glob("store/evaluate/*"))[0]
    label = json.loads((victim / "_manifest.json").read_text())["label"]
    if harm == "gone":
        shutil.rmtree(victim)
    else:
        (victim / "data.bin").write_bytes(
            b"" if harm == "other size" else bytes((victim / "data.bin").stat().st_size)
        )
    told = publish(small_spec, results, code=1)
    assert "1 results cannot be published" in told
    assert label in told
    assert "wasp run SPEC --reuse none" in told
    assert not (results / "published").exists()


@pytest.mark.parametrize("private", ["host", "results", "résultats"])
@pytest.mark.parametrize("place", ["report", "file"])
def test_what_names_this_machine_is_refused(private, place, results, small_spec):
    results = results.rename(results.with_name(private))
    named = HOST if private == "host" else f"{results}/runs"
    text = json.dumps(("é" if private == "host" else "ended\n") + named)
    if place == "report":
        (results / "reports/small/report.md").write_text(f"see {named}\n")
    else:
        victim = sorted(results.glob("store/expert/*"))[0]
        (victim / "half.bin").write_bytes(f"see {text}".encode())
        manifest = json.loads((victim / "_manifest.json").read_text())
        manifest["files"]["half.bin"] = {
            "size": (victim / "half.bin").stat().st_size,
            "sha256": file_digest(victim / "half.bin"),
        }
        (victim / "_manifest.json").write_text(json.dumps(manifest))
    told = publish(small_spec, results, code=1)
    assert "it names " + {"host": "this machine"}.get(private, "the results folder") in told
    assert not (results / "published").exists()


def test_a_machine_named_like_a_method_gives_nothing_away(results, small_spec, monkeypatch):
    monkeypatch.setattr(platform, "node", lambda: "human")
    assert "published in" in publish(small_spec, results)
    assert keys(results / "published") == keys(results)


def test_an_account_without_a_home_can_publish(results, small_spec, monkeypatch):
    def no_entry(_: int) -> None:
        raise KeyError("uid not found")

    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr("pwd.getpwuid", no_entry)
    assert "published in" in publish(small_spec, results)
    assert keys(results / "published") == keys(results)


def test_two_that_publish_to_one_folder_take_turns(results, small_spec, tmp_path, monkeypatch):
    """The second one comes while the first one copies; a sweep of the folder comes too."""
    spec, layout, target = load(small_spec).spec, Layout(results), Layout(tmp_path / "layer")
    found = publish_module.publication(spec, layout, target, [], math.inf, "none")
    waits = threading.Event()
    real, second = (
        publish_module.copy_files,
        threading.Thread(target=carry_publication, args=(found, spec, layout, target, Slimming())),
    )

    def copied(*arguments: Any) -> Any:
        made = real(*arguments)
        if second.ident is None:
            second.start()
            wait_until(lambda: waits.is_set() or not second.is_alive())
            sweep(target)
        return made

    monkeypatch.setattr(publish_module, "copy_files", copied)
    monkeypatch.setattr(
        publish_module, "waiting_aloud", lambda text: lambda: waits.set() or True, raising=False
    )
    carry_publication(found, spec, layout, target, Slimming())
    second.join(300)
    assert keys(target.root) == keys(results)
    for path in target.store.glob("*/*"):
        assert corruption(target, path.parent.name, path.name) is None
        assert {each.name for each in path.iterdir()} == {
            each.name for each in (layout.store / path.relative_to(target.store)).iterdir()
        }
    assert {path.name for path in target.root.iterdir()} == {"store", "reports"}


def test_what_a_killed_publication_left_goes_with_the_next_one(results, small_spec):
    layer = Layout(results / "published")
    left = layer.tmp / "publish" / ("f" * 20)
    left.mkdir(parents=True)
    (left / "data.bin").write_bytes(b"half")
    layer.publishing.write_text("")
    publish(small_spec, results)
    assert {path.name for path in layer.root.iterdir()} == {"store", "reports"}


def test_what_was_reused_is_published_only_on_demand(results, small_spec, fakes, tmp_path):
    publish(small_spec, results)
    fresh = tmp_path / "fresh"
    done = run_here("plan", small_spec, "--results", fresh, "--reuse", results, columns=200, code=2)
    assert "is no folder of published results" in done.stderr
    shutil.copytree(results / "published", fresh / "published")
    assert (
        "published with this code"
        in run_here(
            "plan", small_spec, "--results", fresh, "--reuse", "published", columns=200
        ).output
    )
    run_spec(load(small_spec, ("reuse=published",)), fresh, RunOptions(jobs=0))
    before = tree(fresh / "published")
    told = publish(small_spec, fresh, "--reuse", "published")
    assert tree(fresh / "published") == before
    assert "nodes that were not computed, since nothing needs them: expert, " in told
    # Somewhere else, what stands behind it would be missing only because nobody asked for it; what
    # is there goes along as it was.
    publish(small_spec, fresh, "--reuse", "published", "--to", tmp_path / "third")
    for path in (tmp_path / "third").glob("store/*/*/_manifest.json"):
        assert (
            path.read_bytes()
            == (fresh / "published" / path.relative_to(tmp_path / "third")).read_bytes()
        )
