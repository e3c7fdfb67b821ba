"""The index of manifests says what the manifests say, whatever happens to either."""

import json
import os
import random
import shutil
import threading
from pathlib import Path

import pytest

from tests.plan.test_grid import grid
from tests.plan.test_reasons import store
from wasp_cli.plan import index
from wasp_cli.plan.node import Node
from wasp_cli.plan.reasons import Stored, look_at
from wasp_cli.store.artifact import commit, discard, invalidate, staging_folder
from wasp_cli.store.layout import Layout

NODES = grid().nodes
KINDS = tuple(dict.fromkeys(node.kind for node in NODES))


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of the test's own; a few manifests are enough to be kept, at once."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(index, "LEAST", 1)
    monkeypatch.setattr(index, "RACY", 0.0)
    return tmp_path / "cache"


def looked_at(layout: Layout) -> Stored:
    return look_at(layout, KINDS)


def without_index(layout: Layout, monkeypatch: pytest.MonkeyPatch) -> Stored:
    """What the manifests alone say."""
    with monkeypatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(layout.root.parent / "nothing"))
        patch.setattr(index, "LEAST", 1_000_000)
        return looked_at(layout)


def rewritten(path: Path, text: str) -> None:
    """Another file in the place of one, as editors and `commit` write."""
    aside = path.with_name("aside")
    aside.write_text(text, encoding="utf-8")
    os.replace(aside, path)


def happens(draw: random.Random, layout: Layout) -> None:
    """One thing that runs, `wasp gc`, a full disk or a person do to an artifact."""
    node = draw.choice(NODES)
    place = layout.artifact(node.kind, node.key)
    manifest = layout.manifest(node.kind, node.key)
    if not place.exists():
        store(layout, node, label=f"{draw.random()}")
        return
    what = draw.choice(["removed", "edited", "cut", "empty", "invalid", "data", "grown", "half"])
    if what == "removed":
        discard(place)
    elif what == "data":
        (place / "data.bin").unlink(missing_ok=True)
    elif what == "grown":
        (place / "data.bin").write_bytes(b"x" * draw.randrange(9))
    elif what == "half":
        discard(place)
        place.mkdir(parents=True)
        (place / "data.bin").write_bytes(b"12345")
    elif not manifest.exists():
        discard(place)
    elif what == "edited":
        try:
            values = json.loads(manifest.read_text())
        except ValueError:
            return
        values["provenance"] = {"seconds": draw.random(), "started_at": str(draw.random())}
        rewritten(manifest, json.dumps(values))
    elif what == "cut":
        manifest.write_bytes(manifest.read_bytes()[: draw.randrange(1, 200)])
    elif what == "empty":
        manifest.write_bytes(b"")
    else:
        invalidate(layout, node.kind, node.key, "it was wrong")


@pytest.mark.parametrize("seed", range(3))
def test_it_agrees_with_the_manifests_after_whatever_happens(layout, seed, monkeypatch):
    draw = random.Random(seed)
    for node in NODES:
        store(layout, node)
    for _ in range(12):
        for _ in range(draw.randrange(1, 5)):
            happens(draw, layout)
        assert looked_at(layout) == without_index(layout, monkeypatch)
        assert looked_at(layout) == without_index(layout, monkeypatch)


def test_a_damaged_index_is_read_from_the_manifests_again(layout, cache, monkeypatch):
    for node in NODES:
        store(layout, node)
    expected = looked_at(layout)
    (path,) = cache.rglob("facts-*.json")
    whole = path.read_bytes()
    for damage in (b"", whole[:-100], whole.replace(b"goal1", b"race1"), b"{}"):
        path.write_bytes(damage)
        assert looked_at(layout) == expected
        assert path.read_bytes() == whole
    path.unlink()
    assert looked_at(layout) == expected
    assert path.read_bytes() == whole


def test_a_plan_needs_no_cache_folder(layout, monkeypatch, tmp_path):
    for node in NODES:
        store(layout, node)
    expected = looked_at(layout)
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "file"))
    assert looked_at(layout) == expected


def test_a_file_that_was_just_written_is_read_again(layout, monkeypatch):
    monkeypatch.setattr(index, "RACY", 3600.0)
    node = NODES[0]
    store(layout, node)
    looked_at(layout)
    # The same size, inode and times: a second write within one tick of a coarse clock.
    manifest = layout.manifest(node.kind, node.key)
    before = index.artifact.stamp_of(str(manifest))
    monkeypatch.setattr(index.artifact, "stamp_of", lambda path: before)
    manifest.write_text(manifest.read_text().replace("2026-01-01", "2027-01-01"))
    assert looked_at(layout).whole[node.kind][node.key].at.startswith("2027")


def test_the_results_folder_is_left_as_it_was(layout):
    for node in NODES:
        store(layout, node)
    before = sorted(layout.root.rglob("*"))
    looked_at(layout)
    assert sorted(layout.root.rglob("*")) == before


def test_artifacts_that_come_and_go_meanwhile_are_whole_or_not_there(layout, monkeypatch):
    for node in NODES:
        store(layout, node)
    ended = threading.Event()
    coming, staying = NODES[: len(NODES) // 2], NODES[len(NODES) // 2 :]

    def comes_and_goes(nodes: tuple[Node, ...]) -> None:
        while not ended.is_set():
            for node in nodes:
                shutil.rmtree(layout.artifact(node.kind, node.key), ignore_errors=True)
                folder = staging_folder(layout, node.key)
                commit(layout, node.kind, node.key, folder, {"label": "other"}, copied=True)

    writer = threading.Thread(target=comes_and_goes, args=(coming,))
    writer.start()
    try:
        for _ in range(5):
            found = looked_at(layout)
            for node in staying:
                assert found.whole[node.kind][node.key].seconds == 2.0
    finally:
        ended.set()
        writer.join()
    assert looked_at(layout) == without_index(layout, monkeypatch)
