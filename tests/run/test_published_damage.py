"""Published results that are damaged or untrusted: they make us compute, and no more."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.run.layered import COMMON, MORE, kinds, plan, published_manifest, rewrite, run
from wasp_cli.errors import ArtifactError
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.offered import Listing
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.spec.load import load
from wasp_cli.store import artifact
from wasp_cli.store.artifact import file_digest
from wasp_cli.store.layout import Layout
from wasp_cli.store.published import import_artifact


def test_a_corrupt_file_is_not_used_and_named(here, fakes, small_spec, capsys):
    manifest = published_manifest(here, "goal1 s0 human noisy=0.2")
    data = manifest.with_name("data.bin")
    data.write_bytes(bytes(len(data.read_bytes())))
    before = plan(small_spec, here)
    (note,) = before.grid.notes
    assert note.startswith(f"published evaluate/{manifest.parent.name} is not used: ")
    assert "data.bin' has other bytes than were stored" in note
    done = run(small_spec, here)
    assert done.plan.as_json() == before.as_json()
    assert note in capsys.readouterr().err
    assert [step.node.label for step in before.steps if step.runs] == ["goal1 s0 human noisy=0.2"]
    assert kinds(fakes.executions())["evaluate"] == 1
    # Once the store has it, nobody asks for the published bytes again.
    assert not [step for step in plan(small_spec, here).steps if step.runs]


def test_weights_that_were_rounded_after_their_cells_are_not_used(here, small_spec):
    """As before weights were rounded at the end of training: cells computed with them would
    have other rows under the same keys.
    """
    path = published_manifest(here, "goal1 s0 world_model")
    rewrite(
        path,
        lambda manifest: manifest.update(
            slim={"data.bin": {"left_out": "weights in half precision"}}
        ),
    )
    before = plan(small_spec, here)
    (note,) = before.grid.notes
    assert "has other weights than its cells were computed with" in note
    assert not [
        step
        for step in before.steps
        if step.node.key == path.parent.name and step.state == "published"
    ]


def test_what_breaks_in_the_store_is_brought_in_again(here, fakes, small_spec, moved):
    moved(COMMON)
    run(small_spec, here)
    (here / "store/evaluate").rename(here / "gone")
    broken = next((here / "store/diagnostics").glob("*/data.bin"))
    broken.write_bytes(b"")
    assert {
        step.node.kind for step in plan(small_spec, here).steps if step.state == "published"
    } == {"evaluate", "diagnostics"}
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
    "a manifest that lists itself": names("_manifest.json"),
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
def test_untrusted_results_can_make_us_compute_and_no_more(harm, here, fakes, small_spec):
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
        "secret.bin",
        "away",
        "published",
        "store",
        "tmp",
        "runs",
        "failures",
        "work",
        "locks",
        "index.json",
    }


def test_a_process_reads_a_manifest_once_and_again_when_it_changes(here, small_spec, monkeypatch):
    source, reads, read = Layout(here / "published"), [], artifact.read_manifest
    first, *_ = Listing(source).offers()
    monkeypatch.setattr(
        artifact, "read_manifest", lambda *asked: reads.append(asked) or read(*asked)
    )
    rewrite(
        source.manifest(first.kind, first.key),
        lambda manifest: manifest["provenance"].update(started_at="2001-01-01"),
    )
    assert ("2001-01-01" in {each.started_at for each in Listing(source).offers()}, len(reads)) == (
        True,
        1,
    )
    source.manifest(first.kind, first.key).write_text("{}")
    assert lay_out_over(load(small_spec).spec, Layout(here), str(source.root)).reused, (
        "one that is damaged makes no other folder of it"
    )


def test_two_artifacts_of_one_key_take_nobodys_place(here, fakes, small_spec):
    one = published_manifest(here, "goal1 s0 human noisy=0.2").parent
    other = published_manifest(here, "goal1 s0 diagnostics").parent
    taken = other.with_name(one.name)
    other.rename(taken)
    rewrite(taken / "_manifest.json", lambda manifest: manifest.update(key=one.name))
    found = plan(small_spec, here)
    assert [note for note in found.grid.notes if "two kinds have this key" in note]
    assert len(found.steps) == len(lay_out(load(small_spec).spec).nodes)
    shutil.rmtree(one)
    found = plan(small_spec, here)
    assert [note for note in found.grid.notes if "it has the key of another node" in note]
    assert len({step.node.key for step in found.steps}) == len(lay_out(load(small_spec).spec).nodes)


def test_a_reason_to_be_elsewhere_is_not_followed_into_unknown_versions(
    here, fakes, small_spec, moved
):
    moved(COMMON)
    for number, kind in enumerate(("world_model", "policies")):
        for path in here.glob(f"published/store/{kind}/*/_manifest.json"):
            rewrite(
                path,
                lambda manifest, number=number: manifest["behind"].update(
                    {"f" * 20: f"{number}" * 20}
                ),
            )
    done = run(small_spec, here, MORE)
    assert done.summary.complete
    assert kinds(fakes.executions())["world_model"] == 2


def test_what_changes_after_the_plan_was_made_is_not_brought_in(here, fakes, small_spec):
    offer = next(
        iter(lay_out_over(load(small_spec).spec, Layout(here), "published").reused.values())
    ).offer
    (offer.source.artifact(offer.kind, offer.key) / "data.bin").write_bytes(b"something else")
    with pytest.raises(ArtifactError, match="has other bytes than"):
        import_artifact(Layout(here), offer, lambda: False)
    assert not list((here / "tmp").iterdir())
    assert not list(here.glob("store/*/*"))


def test_a_published_cell_whose_table_cannot_be_read_is_an_error_that_names_it(here, small_spec):
    table = published_manifest(here, "goal1 s0 human noisy=0.2").with_name("episodes.parquet")
    table.write_bytes(b"no table")
    offer = next(
        offer
        for offer in Listing(Layout(here / "published")).offers()
        if offer.key == table.parent.name
    )
    files = {table.name: {"size": 8, "sha256": file_digest(table)}}
    cut = replace(
        offer,
        episodes=1,
        manifest={**offer.manifest, "files": files, "provenance": {"earlier": offer.key}},
    )
    with pytest.raises(ArtifactError, match=f"evaluate/{offer.key}") as caught:
        import_artifact(Layout(here), cut, lambda: False)
    assert caught.value.hint == "run with --reuse none"
