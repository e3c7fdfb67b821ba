import hashlib
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import wasp_cli
from tests.report.invented import invent, write_rows
from wasp_cli.errors import StoreError
from wasp_cli.store import artifact
from wasp_cli.store.artifact import (
    commit,
    damage,
    exists,
    read_manifest,
    staging_folder,
    stored_keys,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held, is_held
from wasp_cli.store.provenance import cuda_devices, git_state
from wasp_cli.store.slim import STEPS_FILE, Slimming, slim, without_steps
from wasp_cli.store.tables import STEPS_FILE as TABLES_STEPS_FILE
from wasp_cli.store.tables import CellIdentity, read_episodes, read_steps

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
    assert read_manifest(layout, "expert", KEY) == {
        "key": KEY,
        "files": {"deep/data": {"size": 3, "sha256": digest}},
    }
    assert stored_keys(layout, "expert") == {KEY}
    assert not list(layout.tmp.iterdir())


def test_the_first_of_two_stays(layout):
    commit(layout, "expert", KEY, staged(layout, "one"), {})
    place = commit(layout, "expert", KEY, staged(layout, "two"), {})
    assert (place / "deep" / "data").read_text() == "one"
    assert not list(layout.tmp.iterdir())


@pytest.mark.parametrize("harm", ["remove", "cut", "{", "{}", '{"files": {"x": {"size": 1e999}}}'])
def test_a_damaged_artifact_is_none_and_gives_way(harm, layout):
    place = commit(layout, "expert", KEY, staged(layout, "one"), {})
    assert exists(layout, "expert", KEY)
    if harm == "remove":
        (place / "deep" / "data").unlink()
    elif harm == "cut":
        (place / "deep" / "data").write_text("o")
    else:
        (place / "_manifest.json").write_text(harm)
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


def test_what_kept_an_artifact_from_its_place_is_told(layout):
    with pytest.raises(OSError, match="Invalid argument"):  # no folder moves into itself
        commit(layout, "expert", KEY, layout.root, {})


def test_a_lock_is_held_by_one_and_ends_with_its_process(layout):
    path = layout.lock(KEY)
    code = (
        "import os; from pathlib import Path; from wasp_cli.store.lock import held\nwith "
        f"held(Path({str(path)!r}), print): os._exit(9)"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], check=False, cwd=Path(__file__).parents[2]
        ).returncode
        == 9
    )
    assert path.exists()
    assert not is_held(path)


def test_sweeping_spares_what_is_being_written(layout):
    staged(layout, "left behind")
    mine = staging_folder(layout, OTHER)
    (layout.tmp / "unknown").mkdir()
    with held(layout.lock(OTHER), lambda: None):
        assert artifact.sweep(layout) == 1
    assert sorted(path.name for path in layout.tmp.iterdir()) == sorted([mine.name, "unknown"])


@pytest.mark.parametrize("name", ["", "..", ".hidden", "a/b", "a\\b", "a b", "x" * 200, "\x00"])
def test_names_never_become_paths_unchecked(name, layout):
    for make in (
        layout.kind,
        layout.reports,
        layout.run,
        lambda key: layout.artifact("expert", key),
        layout.work,
        layout.failure,
    ):
        with pytest.raises(StoreError):
            make(name)


# Where an artifact came from: two states of the source are told apart, and looking costs little.


def git(root: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
    return subprocess.run(
        ["git", "-C", str(root), *identity, *arguments], check=True, capture_output=True, text=True
    ).stdout.strip()


@pytest.fixture
def checkout(tmp_path, monkeypatch) -> Path:
    package = tmp_path / "wasp_cli"
    (package / "deep").mkdir(parents=True)
    for name in ("__init__.py", "one.py", "deep/two.py"):
        (package / name).write_text("x = 1\n")
    (tmp_path / "README.md").write_text("text\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    monkeypatch.setattr(wasp_cli, "__file__", str(package / "__init__.py"))
    return tmp_path


def changes(text: str, path: Path) -> str | None:
    path.write_text(text)
    state = git_state()
    assert state["dirty"]
    found: str | None = state["changes"]
    return found


def test_a_clean_checkout_is_its_commit(checkout):
    assert git_state() == {
        "sha": git(checkout, "rev-parse", "HEAD"),
        "dirty": False,
        "changes": None,
    }


def test_each_change_of_the_package_has_a_hash_of_its_own(checkout):
    package = checkout / "wasp_cli"
    found = [
        changes("x = 2\n", package / "one.py"),
        changes("x = 3\n", package / "one.py"),
        changes("x = 3\n", package / "deep" / "two.py"),
        changes("x = 1\n", package / "deep" / "new.py"),  # not tracked
        changes("x = 2\n", package / "deep" / "new.py"),
    ]
    (package / "one.py").unlink()
    state = git_state()
    found.append(state["changes"])
    assert len(set(found)) == len(found)
    assert all(text is not None and len(text) == 16 for text in found)


def test_what_is_not_the_package_is_dirty_and_no_change_of_it(checkout):
    assert changes("other\n", checkout / "README.md") is None


def test_outside_of_a_checkout_there_is_nothing_to_say(tmp_path, monkeypatch):
    monkeypatch.setattr(wasp_cli, "__file__", str(tmp_path / "wasp_cli" / "__init__.py"))
    assert git_state() is None
    (tmp_path / ".git").mkdir()  # a damaged one
    assert git_state() is None


def test_devices_are_named_only_where_this_process_computes_on_them(monkeypatch):
    def fake(initialized: bool) -> SimpleNamespace:
        cuda = SimpleNamespace(
            is_initialized=lambda: initialized,
            device_count=lambda: 2,
            get_device_name=lambda index: f"GPU {index}",
        )
        return SimpleNamespace(cuda=cuda)

    monkeypatch.setitem(sys.modules, "torch", fake(True))
    assert cuda_devices() == ["GPU 0", "GPU 1"]
    monkeypatch.setitem(sys.modules, "torch", fake(False))
    assert cuda_devices() == []
    monkeypatch.delitem(sys.modules, "torch")
    assert cuda_devices() == []


# Smaller published copies: what is left out is said, and nothing else changes.


def cell(folder: Path, episodes: int = 4) -> Path:
    folder.mkdir()
    return write_rows(
        folder,
        CellIdentity("goal1", "wasp", "full", "noisy", 0.4, 0),
        [invent(e, 5, 0.2, 0.05, steps=7) for e in range(episodes)],
    )


def test_steps_of_the_first_episodes_stay_and_the_rows_of_episodes_are_not_touched(tmp_path):
    assert STEPS_FILE == TABLES_STEPS_FILE
    path = cell(tmp_path / "cell")
    rows, steps = path.read_bytes(), read_steps(path)
    said = slim(tmp_path / "cell", "evaluate", Slimming(steps=1))
    assert said[STEPS_FILE]["left_out"] == "steps of all episodes but the first"
    assert path.read_bytes() == rows
    assert read_episodes([path]).num_rows == 4
    assert read_steps(path).equals(steps.slice(0, 7))
    assert without_steps({"kind": "evaluate", "slim": said})
    assert not without_steps({"kind": "evaluate"})
    assert not without_steps({"kind": "critics", "slim": {"m.safetensors": {}}})
    assert slim(tmp_path / "cell", "evaluate", Slimming(steps=1)) == {}
    assert (
        slim(tmp_path / "cell", "evaluate", Slimming(steps=0))[STEPS_FILE]["left_out"]
        == "all steps"
    )


def test_images_of_diagnostics_are_left_out_where_that_is_asked_for_and_nothing_else(tmp_path):
    (tmp_path / "images.parquet").write_bytes(b"frames")
    (tmp_path / "diagnostics.json").write_text("{}")
    assert slim(tmp_path, "diagnostics", Slimming()) == {}
    assert slim(tmp_path, "dataset", Slimming(images=False)) == {}
    whole = artifact.file_digest(tmp_path / "images.parquet")
    assert slim(tmp_path, "diagnostics", Slimming(images=False)) == {
        "images.parquet": {"left_out": "images", "sha256": whole}
    }
    assert [path.name for path in tmp_path.iterdir()] == ["diagnostics.json"]
