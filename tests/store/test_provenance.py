"""Where an artifact came from: two states of the source are told apart, and looking costs little."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import wasp_cli
from wasp_cli.store.provenance import cuda_devices, git_state


def git(root: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
    return subprocess.run(["git", "-C", str(root), *identity, *arguments], check=True, capture_output=True, text=True).stdout.strip()


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
    assert git_state() == {"sha": git(checkout, "rev-parse", "HEAD"), "dirty": False, "changes": None}


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
        cuda = SimpleNamespace(is_initialized=lambda: initialized, device_count=lambda: 2, get_device_name=lambda index: f"GPU {index}")
        return SimpleNamespace(cuda=cuda)

    monkeypatch.setitem(sys.modules, "torch", fake(True))
    assert cuda_devices() == ["GPU 0", "GPU 1"]
    monkeypatch.setitem(sys.modules, "torch", fake(False))
    assert cuda_devices() == []
    monkeypatch.delitem(sys.modules, "torch")
    assert cuda_devices() == []
