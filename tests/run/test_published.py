"""Published results over fake stages: what is used instead of computed, under whose key, and what a stranger's files can do."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.run.harness import Fakes, data_of
from wasp_cli.console import err
from wasp_cli.errors import ArtifactError, UsageError
from wasp_cli.plan import grid, reasons, reuse
from wasp_cli.plan.closure import closure
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.run.publish import carry_publication, publication
from wasp_cli.run.session import Session, Way, run_spec
from wasp_cli.run.sweep import run_sweep
from wasp_cli.spec.load import load
from wasp_cli.spec.sweep import read_sweep
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import Busy, held
from wasp_cli.store.published import bring_in

SPECIFIC = "wasp_cli.methods.ida"
"""A module that some nodes run, none of them one that others read but a calibration."""
COMMON = "wasp_cli.tasks.goal.task"
"""A module that every node runs."""
MORE = ("operators={noisy: {mild: 0.2, severe: 0.6}, laggy: {moderate: 0.7}}",)
"""One more severity than the spec has."""


@pytest.fixture(autouse=True)
def fresh_console() -> Iterator[None]:
    """The console keeps the stream of its first use, which is closed after the test."""
    err.cache_clear()
    yield
    err.cache_clear()


@pytest.fixture
def moved(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Changes the code of a module, as far as plans can see."""
    hashed, sources = grid.closure_hash, reasons.source_hashes

    def change(module: str) -> None:
        monkeypatch.setattr(grid, "closure_hash", lambda roots: hashed(roots) + ("moved" if module in closure(roots) else ""))
        monkeypatch.setattr(
            reasons, "source_hashes", lambda roots: {name: "moved" if name == module else old for name, old in sources(roots).items()}
        )

    return change


@pytest.fixture
def here(fakes: Fakes, small_spec: Path, tmp_path: Path) -> Path:
    """A fresh results folder with the published results of the spec, which were computed elsewhere."""
    elsewhere = Layout(tmp_path / "elsewhere")
    run_spec(load(small_spec), elsewhere.root, Way(jobs=0))
    fresh = tmp_path / "results"
    publish(small_spec, elsewhere, Layout(fresh / "published"))
    fakes.log.unlink()
    err.cache_clear()
    return fresh


def publish(spec: Path, layout: Layout, target: Layout) -> None:
    found = publication(load(spec).spec, layout, target, (), 8e6, "none")
    carry_publication(found, load(spec).spec, layout, target)


def run(spec: Path, results: Path, settings: tuple[str, ...] = (), choice: str = "published") -> Session:
    done = run_spec(load(spec, settings), results, Way(jobs=0), reuse=choice)
    done.require_complete()
    return done


def plan(spec: Path, results: Path, settings: tuple[str, ...] = (), choice: str = "published") -> Plan:
    layout = Layout(results)
    return plan_against(lay_out_over(load(spec, settings).spec, layout, choice), layout)


def kinds(executions: list[str]) -> Counter[str]:
    return Counter(line.split()[2] for line in executions)


def node_of(plan: Plan, label: str) -> Node:
    return next(step.node for step in plan.steps if step.node.label == label)


def published_manifest(results: Path, label: str) -> Path:
    found = [path for path in results.glob("published/store/*/*/manifest.json") if json.loads(path.read_text())["label"] == label]
    return found[0]


def rewrite(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


def test_a_fresh_folder_computes_nothing_that_is_published(
    here: Path, fakes: Fakes, small_spec: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = plan(small_spec, here)
    done = run(small_spec, here)
    assert not fakes.executions()
    assert done.plan.as_json() == before.as_json()
    # What is asked for is brought in, and nothing that only stands behind it.
    taken = {step.node for step in before.steps if step.state == "published"}
    assert {node.key for node in taken} == before.grid.targets == {path.parent.name for path in here.glob("store/*/*/manifest.json")}
    assert {step.reason for step in before.steps if step.node in taken} == {"published with this code"}
    assert {step.reason for step in before.steps if step.node not in taken} == {"everything that needs it is computed"}
    assert data_of(here).items() <= data_of(tmp_path / "elsewhere").items()
    assert f"0 computed, 0 computed before, {len(taken)} published in" in capsys.readouterr().err
    assert plan(small_spec, here).count("cached") == len(taken)
    # The code is the same, so the keys are those that they would have been anyway.
    assert {node.key for node in lay_out(load(small_spec).spec).nodes} == {step.node.key for step in before.steps}


def test_without_reuse_everything_is_computed(here: Path, fakes: Fakes, small_spec: Path) -> None:
    done = run(small_spec, here, choice="none")
    assert len(fakes.executions()) == done.summary.done == len(done.plan.steps)
    assert not done.plan.grid.reused


def test_what_was_computed_under_todays_code_comes_first(here: Path, fakes: Fakes, small_spec: Path, moved: Callable[[str], None]) -> None:
    moved(SPECIFIC)
    run(small_spec, here, choice="none")
    found = plan(small_spec, here)
    assert found.count("cached") == len(found.steps)
    assert {step.reason for step in found.steps} == {"computed before", "published with this code"}
    assert {node.key for node in found.grid.nodes} == {node.key for node in lay_out(load(small_spec).spec).nodes}


def test_the_spec_says_what_is_reused_and_the_option_wins(here: Path, fakes: Fakes, small_spec: Path) -> None:
    layout = Layout(here)
    assert not lay_out_over(load(small_spec).spec, layout).reused
    assert lay_out_over(load(small_spec, ("reuse=published",)).spec, layout).reused
    assert not lay_out_over(load(small_spec, ("reuse=published",)).spec, layout, "none").reused
    run_spec(load(small_spec, ("reuse=published",)), here, Way(jobs=0))
    assert not fakes.executions()


def test_a_published_folder_elsewhere(here: Path, fakes: Fakes, small_spec: Path, tmp_path: Path) -> None:
    other = here.rename(tmp_path / "cloned") / "published"
    run(small_spec, tmp_path / "new", choice=str(other))
    assert not fakes.executions()
    for wrong in ("publishd", "", str(tmp_path)):
        with pytest.raises(UsageError, match="holds no published results"):
            plan(small_spec, tmp_path / "new", choice=wrong)


def test_when_the_code_has_moved_on_the_plan_names_it(
    here: Path, fakes: Fakes, small_spec: Path, moved: Callable[[str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite(published_manifest(here, "goal1 s0 ida noisy=0.2"), lambda manifest: manifest["provenance"].update(git={"sha": "abcdef0123"}))
    moved(SPECIFIC)
    found = {step.node.label: step for step in plan(small_spec, here).steps}
    assert found["goal1 s0 ida noisy=0.2"].reason == f"published by other code: {SPECIFIC} (git abcdef0)"
    assert found["goal1 s0 human noisy=0.2"].reason == "published with this code"
    run(small_spec, here)
    assert not fakes.executions()
    assert f"published by other code: {SPECIFIC} (git abcdef0)" in capsys.readouterr().err
    assert found["goal1 s0 ida noisy=0.2"].node.key not in {node.key for node in lay_out(load(small_spec).spec).nodes}


def test_what_was_computed_from_other_code_is_other_code(here: Path, small_spec: Path, moved: Callable[[str], None]) -> None:
    module = "wasp_cli.methods.wasp.gates"
    moved(module)
    calibration, *_ = [step for step in plan(small_spec, here).steps if step.node.label == "goal1 s0 calibration wasp"]
    assert module in closure(calibration.node.modules)
    rewrite(
        published_manifest(here, "goal1 s0 wasp noisy=0.2"),
        lambda manifest: manifest.update(sources=reasons.source_hashes(node_of(plan(small_spec, here), "goal1 s0 wasp noisy=0.2").modules)),
    )
    found = {step.node.label: step.reason for step in plan(small_spec, here).steps}
    assert found["goal1 s0 wasp noisy=0.2"].startswith("published by other code: that of what it was computed from")


def test_what_is_computed_from_published_results_has_keys_that_say_so(
    here: Path, fakes: Fakes, small_spec: Path, moved: Callable[[str], None]
) -> None:
    moved(COMMON)
    before = plan(small_spec, here, MORE)
    done = run(small_spec, here, MORE)
    new = [step.node for step in before.steps if step.runs]
    assert all("noisy=0.6" in node.label for node in new)
    assert kinds(fakes.executions()) == {"evaluate": len(new)} == {"evaluate": 2 * 3}
    without = {node.label: node.key for node in lay_out(load(small_spec, MORE).spec).nodes}
    for node in new:
        assert node.key != without[node.label]
        manifest = read_manifest(done.layout, node.kind, node.key)
        assert manifest["upstream"] == {name: needed.key for name, needed in node.needs.items()}
        assert all(needed.key in before.grid.reused for needed in node.needs.values())
    # Under the code of today, nothing of it counts.
    assert plan(small_spec, here, MORE, "none").count("cached") == 0


def test_a_part_that_was_not_published_is_no_reason_to_train_what_was(
    here: Path, fakes: Fakes, small_spec: Path, moved: Callable[[str], None]
) -> None:
    for kind in ("expert", "dataset", "heldout"):
        shutil.rmtree(here / "published/store" / kind)
    moved(COMMON)
    run(small_spec, here, (*MORE, "methods=[human, ida, wasp]"))
    assert kinds(fakes.executions())["world_model"] == 0
    assert kinds(fakes.executions())["critics"] == 0


def test_results_of_two_codes_are_never_mixed_behind_one_node(
    here: Path, fakes: Fakes, small_spec: Path, moved: Callable[[str], None]
) -> None:
    shutil.rmtree(here / "published/store/world_model")
    moved(COMMON)
    # The world model would be another one: what was trained on the states of the first one does not go with it.
    done = run(small_spec, here, MORE)
    ran = kinds(fakes.executions())
    assert ran["world_model"] == ran["critics"] == ran["policies"] == 2
    published = set(done.plan.grid.reused)
    for step in done.plan.steps:
        if step.runs:
            assert {needed.kind for needed in step.node.needs.values() if needed.key in published} <= {"expert", "dataset", "heldout"}
    # The cells that are published are still those.
    assert ran["evaluate"] == 2 * 3
    assert done.plan.count("published", "evaluate") == len({node.key for _, node in done.plan.grid.cells}) - 2 * 3


def test_with_the_same_code_a_missing_part_is_computed_and_the_rest_is_used(here: Path, fakes: Fakes, small_spec: Path) -> None:
    shutil.rmtree(here / "published/store/world_model")
    run(small_spec, here, MORE)
    assert kinds(fakes.executions()) == {"world_model": 2, "evaluate": 2 * 3}


def test_a_corrupt_file_is_not_used_and_named(here: Path, fakes: Fakes, small_spec: Path, capsys: pytest.CaptureFixture[str]) -> None:
    manifest = published_manifest(here, "goal1 s0 human noisy=0.2")
    data = manifest.with_name("data.bin")
    data.write_bytes(bytes(len(data.read_bytes())))
    before = plan(small_spec, here)
    (note,) = before.grid.notes
    assert note.startswith(f"published evaluate/{manifest.parent.name} is not used: ")
    assert "data.bin' does not have the bytes that were published" in note
    done = run(small_spec, here)
    assert done.plan.as_json() == before.as_json()
    assert note in capsys.readouterr().err
    assert [step.node.label for step in before.steps if step.runs] == ["goal1 s0 human noisy=0.2"]
    assert kinds(fakes.executions())["evaluate"] == 1
    # Once the store has it, nobody asks for the published bytes again.
    assert not [step for step in plan(small_spec, here).steps if step.runs]


def test_what_breaks_in_the_store_is_brought_in_again(here: Path, fakes: Fakes, small_spec: Path, moved: Callable[[str], None]) -> None:
    moved(COMMON)
    run(small_spec, here)
    (here / "store/evaluate").rename(here / "gone")
    broken = next((here / "store/diagnostics").glob("*/data.bin"))
    broken.write_bytes(b"")
    assert {step.node.kind for step in plan(small_spec, here).steps if step.state == "published"} == {"evaluate", "diagnostics"}
    run(small_spec, here)
    assert not fakes.executions()
    assert broken.stat().st_size


def names(name: str) -> Callable[[Path, dict[str, Any]], None]:
    def change(path: Path, manifest: dict[str, Any]) -> None:
        manifest["files"][name] = manifest["files"].pop("data.bin")

    return change


def linked(path: Path, manifest: dict[str, Any]) -> None:
    data = path.with_name("data.bin")
    data.rename(path.parents[4] / "secret.bin")
    data.symlink_to(path.parents[4] / "secret.bin")


def linked_folder(path: Path, manifest: dict[str, Any]) -> None:
    away = path.parents[4] / "away"
    path.parent.rename(away)
    path.parent.symlink_to(away)


HARMS: dict[str, Callable[[Path, dict[str, Any]], object]] = {
    "a name that leads out": names("../../../../secret.bin"),
    "an absolute name": names("/etc/hostname"),
    "a manifest that lists itself": names("manifest.json"),
    "a link": linked,
    "an artifact that is a link": linked_folder,
    "another digest": lambda path, manifest: manifest["files"]["data.bin"].update(sha256="0" * 64),
    "no digest": lambda path, manifest: manifest["files"]["data.bin"].pop("sha256"),
    "no list": lambda path, manifest: manifest.update(files=[1]),
    "another kind": lambda path, manifest: manifest.update(kind="expert"),
    "another key": lambda path, manifest: manifest.update(key="0" * 20),
    "no recipe": lambda path, manifest: manifest.pop("recipe"),
    "a recipe that is no text": lambda path, manifest: manifest.update(recipe=7),
    "nothing behind it": lambda path, manifest: manifest.update(behind=None),
    "odd things behind it": lambda path, manifest: manifest.update(behind={"../x": "y"}),
    "no provenance": lambda path, manifest: manifest.update(provenance=None),
    "no sources": lambda path, manifest: manifest.update(sources=None),
}


@pytest.mark.parametrize("harm", HARMS)
def test_a_stranger_can_make_us_compute_and_no_more(harm: str, here: Path, fakes: Fakes, small_spec: Path) -> None:
    path = published_manifest(here, "goal1 s1 human laggy=0.7")
    manifest = json.loads(path.read_text())
    (here / "secret.bin").write_bytes(b"mine")
    HARMS[harm](path, manifest)
    if path.is_file():
        path.write_text(json.dumps(manifest))
    secret = (here / "secret.bin").read_bytes()
    run(small_spec, here)
    assert kinds(fakes.executions())["evaluate"] == 1
    assert any(" evaluate human " in line and " s1 " in line for line in fakes.executions())
    assert (here / "secret.bin").read_bytes() == secret
    assert {item.name for item in here.iterdir()} <= {
        "secret.bin", "away", "published", "store", "tmp", "runs", "failures", "work", "locks", "index.json",
    }  # fmt: skip


def test_two_artifacts_of_one_key_take_nobodys_place(here: Path, fakes: Fakes, small_spec: Path) -> None:
    one = published_manifest(here, "goal1 s0 human noisy=0.2").parent
    other = published_manifest(here, "goal1 s0 diagnostics").parent
    taken = other.with_name(one.name)
    other.rename(taken)
    rewrite(taken / "manifest.json", lambda manifest: manifest.update(key=one.name))
    found = plan(small_spec, here)
    assert [note for note in found.grid.notes if "two kinds have this key" in note]
    assert len(found.steps) == len(lay_out(load(small_spec).spec).nodes)
    shutil.rmtree(one)
    found = plan(small_spec, here)
    assert [note for note in found.grid.notes if "it has the key of another node" in note]
    assert len({step.node.key for step in found.steps}) == len(lay_out(load(small_spec).spec).nodes)


def test_a_reason_to_be_elsewhere_is_not_followed_into_unknown_versions(
    here: Path, fakes: Fakes, small_spec: Path, moved: Callable[[str], None]
) -> None:
    moved(COMMON)
    for number, kind in enumerate(("world_model", "policies")):
        for path in here.glob(f"published/store/{kind}/*/manifest.json"):
            rewrite(path, lambda manifest, number=number: manifest["behind"].update({"f" * 20: f"{number}" * 20}))
    done = run(small_spec, here, MORE)
    assert done.summary.complete
    assert kinds(fakes.executions())["world_model"] == 2


def test_nothing_is_spent_where_nothing_is_reused(fakes: Fakes, small_spec: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[str] = []
    monkeypatch.setattr(grid, "recipe_of", lambda identity: called.append("recipe"))
    monkeypatch.setattr(reuse, "offers", lambda source: called.append("offers") or ([], []))
    counted = []
    real = grid.key_of
    monkeypatch.setattr(grid, "key_of", lambda identity: counted.append(1) or real(identity))
    plain = lay_out(load(small_spec).spec)
    once = len(counted)
    assert lay_out_over(load(small_spec).spec, Layout(tmp_path)) == plain
    assert not called
    assert len(counted) == 2 * once
    # With an empty published folder there is one look, and no more work for the nodes.
    assert lay_out_over(load(small_spec).spec, Layout(tmp_path), "published") == plain
    assert called == ["offers"]
    assert len(counted) == 3 * once


def test_a_sweep_follows_its_spec(here: Path, fakes: Fakes, small_spec: Path, moved: Callable[[str], None]) -> None:
    moved(COMMON)
    swept = read_sweep(small_spec, "wasp.tau_c=0.3,0.5", ("human", "wasp"), ("reuse=published",))
    done = run_sweep(swept, here, Way(jobs=0))
    assert done.session.summary.complete
    # Nothing is trained, Human-only is there, and so is WASP under one of the values.
    assert kinds(fakes.executions()) == {"calibration": 2, "evaluate": 2 * 2}
    assert done.session.plan.count("published", "evaluate") == 2 * 2 * 2


def test_what_the_store_has_is_not_brought_in_again(here: Path, fakes: Fakes, small_spec: Path) -> None:
    reused = next(iter(lay_out_over(load(small_spec).spec, Layout(here), "published").reused.values()))
    layout = Layout(here)
    assert bring_in(layout, reused.offer, lambda: False)
    assert read_manifest(layout, reused.offer.kind, reused.offer.key) == {
        **reused.offer.manifest,
        "provenance": {**reused.offer.manifest["provenance"], "published": True},
    }
    assert not bring_in(layout, reused.offer, lambda: False)
    with held(layout.lock(reused.offer.key), lambda: False), pytest.raises(Busy):
        bring_in(layout, reused.offer, lambda: False)


def test_what_changes_after_the_plan_was_made_is_not_brought_in(here: Path, fakes: Fakes, small_spec: Path) -> None:
    offer = next(iter(lay_out_over(load(small_spec).spec, Layout(here), "published").reused.values())).offer
    (offer.source.artifact(offer.kind, offer.key) / "data.bin").write_bytes(b"something else")
    with pytest.raises(ArtifactError, match="does not have the bytes"):
        bring_in(Layout(here), offer, lambda: False)
    assert not list((here / "tmp").iterdir())
    assert not list(here.glob("store/*/*"))
