"""Where published results are unpacked when nobody may write to the package: also by an account
without a home folder.
"""

import os
import shutil
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.commands import run_here
from wasp_cli.cli.doctor import Finding, examine
from wasp_cli.errors import StoreError
from wasp_cli.spec import shipped
from wasp_cli.store.layout import Layout
from wasp_cli.store.packs import write_pack

ROWS = "store/evaluate/aa/rows"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed package whose published results are in a pack, and nobody may write to."""
    root = tmp_path / "package" / "published"
    (root / ROWS).parent.mkdir(parents=True)
    (root / ROWS).write_text("rows")
    (root / "packs").mkdir()
    assert write_pack(root, "mine")
    shutil.rmtree(root / "store" / "evaluate")
    next((root / "packs").glob(".*")).unlink()
    monkeypatch.setattr(shipped, "_PACKAGE", root.parent)
    for folder in (root, *root.glob("*")):
        folder.chmod(0o555)
    allowed = os.access

    # root may write there in spite of the modes
    def access(path: Path, mode: int) -> bool:
        return allowed(path, mode) and not (
            mode & os.W_OK and Path(path).is_relative_to(root.parent)
        )

    monkeypatch.setattr(os, "access", access)
    return root


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the user below an empty one for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder / f"wasp-{os.geteuid()}"


def no_entry(_: int) -> None:
    raise KeyError("uid not found")


HOMES = ("none", "a file", "behind a file", "relative", "XDG_CACHE_HOME is a file")


@pytest.fixture
def home(request, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Take the home folder away from this account, in one of the ways that containers have."""
    file = tmp_path / "file"
    file.touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if request.param == "none":
        monkeypatch.delenv("HOME", raising=False)
        monkeypatch.setattr("pwd.getpwuid", no_entry)
    elif request.param == "XDG_CACHE_HOME is a file":
        monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    else:
        places = {"a file": file, "behind a file": file / "home", "relative": Path("somewhere")}
        monkeypatch.setenv("HOME", str(places[request.param]))
    return request.param


def cache_row(tmp_path: Path) -> Finding:
    return next(found for found in examine(tmp_path / "results") if found.what == "cache")


@pytest.mark.parametrize("home", HOMES, indirect=True)
def test_without_a_home_a_folder_of_the_users_own_takes_its_place(
    home: str, package: Path, temporary: Path, tmp_path: Path
) -> None:
    before = cache_row(tmp_path)
    assert before.state == "limited"
    assert str(temporary) in before.found
    assert not temporary.exists()
    copy = shipped.published_folder()
    assert copy is not None
    assert copy.parent == temporary
    assert (Layout(copy).root / ROWS).read_text() == "rows"
    assert stat.S_IMODE(temporary.stat().st_mode) == stat.S_IRWXU
    assert shipped.published_folder() == copy
    assert list(temporary.iterdir()) == [copy]
    assert cache_row(tmp_path).state == "limited"
    assert not (tmp_path / "somewhere").exists()


def linked(place: Path) -> None:
    elsewhere = place.with_name("elsewhere")
    elsewhere.mkdir(mode=0o700)
    place.symlink_to(elsewhere)


def opened(place: Path) -> None:
    place.mkdir()
    place.chmod(0o777)


PREPARED = {"a link": linked, "open to others": opened, "a file": Path.touch}


@pytest.mark.parametrize("prepared", PREPARED.values(), ids=PREPARED)
@pytest.mark.parametrize("home", ["none"], indirect=True)
def test_a_folder_that_others_could_have_made_is_not_used(
    prepared: Callable[[Path], None], home: str, package: Path, temporary: Path, tmp_path: Path
) -> None:
    prepared(temporary)
    with pytest.raises(StoreError, match="only this user's") as refused:
        shipped.published_folder()
    assert "XDG_CACHE_HOME" in (refused.value.hint or "")
    assert cache_row(tmp_path).state == "missing"
    assert "XDG_CACHE_HOME" in run_here("doctor", "--results", tmp_path, columns=300, code=1).output
    assert not [*temporary.parent.glob("*/*")]


def test_a_home_is_used_where_there_is_one(
    package: Path, temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    # names no folder from the root, and is to be ignored
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    (tmp_path / "home").mkdir()
    assert cache_row(tmp_path).state == "ok"
    copy = shipped.published_folder()
    assert copy is not None
    assert copy.parent == tmp_path / "home" / ".cache" / "wasp"
    assert not temporary.exists()


def test_a_full_cache_is_left_for_the_next_one(
    package: Path, temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy_file = shutil.copyfile

    def full(source: Path, target: Path) -> None:
        if Path(target).is_relative_to(tmp_path / "home"):
            raise OSError(28, "No space left on device")
        copy_file(source, target)

    monkeypatch.setattr(shutil, "copyfile", full)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    copy = shipped.published_folder()
    assert copy is not None
    assert copy.parent == temporary
    assert not list((tmp_path / "home" / ".cache" / "wasp").iterdir())


def test_a_package_that_can_be_written_needs_no_cache(
    temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "file" / "home"))
    assert cache_row(tmp_path).state == "ok"
    assert not temporary.exists()
