import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

from wasp_cli.errors import StoreError
from wasp_cli.store.artifact import (
    commit,
    damage,
    exists,
    read_manifest,
    staging_folder,
    stored_keys,
    sweep,
)  # fmt: skip
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held, is_held

KEY, OTHER = "a" * 20, "b" * 20


def staged(layout: Layout, content: str) -> Path:
    folder = staging_folder(layout, KEY)
    (folder / "deep").mkdir()
    (folder / "deep" / "data").write_text(content)
    return folder


def test_an_artifact_appears_whole(layout):
    assert stored_keys(layout, "expert") == set()
    place = commit(layout, "expert", KEY, staged(layout, "one"), {"key": KEY})
    assert (place / "deep" / "data").read_text() == "one"
    digest = hashlib.sha256(b"one").hexdigest()
    assert read_manifest(layout, "expert", KEY) == {"key": KEY, "files": {"deep/data": {"size": 3, "sha256": digest}}}
    assert stored_keys(layout, "expert") == {KEY}
    assert not list(layout.tmp.iterdir())


def test_the_first_of_two_stays(layout):
    commit(layout, "expert", KEY, staged(layout, "one"), {})
    place = commit(layout, "expert", KEY, staged(layout, "two"), {})
    assert (place / "deep" / "data").read_text() == "one"
    assert not list(layout.tmp.iterdir())


@pytest.mark.parametrize("harm", ["remove", "cut", "manifest", "empty manifest"])
def test_a_damaged_artifact_is_none_and_gives_way(harm, layout):
    place = commit(layout, "expert", KEY, staged(layout, "one"), {})
    assert exists(layout, "expert", KEY)
    if harm == "remove":
        (place / "deep" / "data").unlink()
    elif harm == "cut":
        (place / "deep" / "data").write_text("o")
    else:
        (place / "_manifest.json").write_text("{" if harm == "manifest" else "{}")
    assert not exists(layout, "expert", KEY)
    assert str(place) in (damage(layout, "expert", KEY) or "")
    commit(layout, "expert", KEY, staged(layout, "one"), {})
    assert damage(layout, "expert", KEY) is None
    assert (place / "deep" / "data").read_text() == "one"
    assert not list(layout.tmp.iterdir())


def test_a_manifest_without_a_json_form_publishes_nothing(layout):
    with pytest.raises(ValueError, match="JSON"):
        commit(layout, "expert", KEY, staged(layout, "one"), {"loss": float("nan")})
    assert not layout.artifact("expert", KEY).exists()


def test_a_lock_is_held_by_one_and_ends_with_its_process(layout):
    path = layout.lock(KEY)
    assert not is_held(path)
    with held(path, lambda: None):
        assert is_held(path)
    assert not is_held(path)
    code = f"import os; from pathlib import Path; from wasp_cli.store.lock import held\nwith held(Path({str(path)!r}), print): os._exit(9)"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=Path(__file__).parents[2]).returncode == 9
    assert path.exists()
    assert not is_held(path)


def test_sweeping_spares_what_is_being_written(layout):
    staged(layout, "left behind")
    mine = staging_folder(layout, OTHER)
    (layout.tmp / "unknown").mkdir()
    with held(layout.lock(OTHER), lambda: None):
        assert sweep(layout) == 1
    assert sorted(path.name for path in layout.tmp.iterdir()) == sorted([mine.name, "unknown"])


@pytest.mark.parametrize("name", ["", "..", ".hidden", "a/b", "a\\b", "a b", "x" * 200, "\x00"])
def test_names_never_become_paths_unchecked(name, layout):
    for make in (layout.kind, layout.reports, layout.run, lambda key: layout.artifact("expert", key), layout.work, layout.failure):
        with pytest.raises(StoreError):
            make(name)
