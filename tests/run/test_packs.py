"""Packs of small artifacts: the same files again, by several processes at once, and an error of
a pack that is not ours.
"""

import io
import lzma
import os
import shutil
import tarfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.run.layered import plan, publish, run
from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.spec import shipped
from wasp_cli.store import packs
from wasp_cli.store.layout import Layout
from wasp_cli.store.packs import KINDS, tar_of, unpack, write_pack

SHIPPED = Path(__file__).parents[2] / "results" / "published"


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in (folder / "store").rglob("*")
        if path.is_file()
    }


@pytest.fixture
def root(tmp_path) -> Path:
    """A published folder whose small artifacts are packed, and unpacked."""
    for name, text in {
        "evaluate/aa/rows": "r" * 99,
        "evaluate/bb/deep/rows": "s",
        "diagnostics/cc/d.json": "{}",
        "critics/dd/w": "w",
    }.items():
        path = tmp_path / "here" / "store" / name
        path.parent.mkdir(parents=True)
        path.write_text(text)
    (tmp_path / "here" / "packs").mkdir()
    assert write_pack(tmp_path / "here", "mine")
    return tmp_path / "here"


def cloned(root: Path, clone: Path) -> Path:
    """A copy of what git has of a published folder."""
    shutil.copytree(root, clone, ignore=shutil.ignore_patterns(".*", *KINDS))
    return clone


def test_a_clone_has_the_same_files(root, tmp_path):
    clone = cloned(root, tmp_path / "clone")
    assert list(files(clone)) == ["store/critics/dd/w"]
    assert Layout(clone).root == clone
    assert files(clone) == files(root)
    assert write_pack(clone, "more") is None
    (clone / "store/evaluate/aa/rows").write_text("what lies there stays")
    next((clone / "packs").glob(".*")).unlink()
    unpack(clone)
    assert (clone / "store/evaluate/aa/rows").read_text() == "what lies there stays"
    (clone / "store/evaluate/ee").mkdir()
    (clone / "store/evaluate/ee/rows").write_text("t")
    pack = write_pack(clone, "more")
    with tarfile.open(pack) as archive:
        assert archive.getnames() == ["evaluate/ee/rows"]


def test_several_processes_unpack_at_once_and_one_that_was_killed_is_gone_on_with(root, tmp_path):
    clone = cloned(root, tmp_path / "clone")
    # as far as it had come
    shutil.copytree(root / "store/evaluate/bb", clone / "store/evaluate/bb")
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(unpack, [clone] * 40))
    assert files(clone) == files(root)
    assert not list((clone / "packs").glob(".unpacking*"))


@pytest.mark.parametrize(
    "member",
    [
        "evaluate/aa",
        "../aa/rows",
        "evaluate/../../rows",
        "/evaluate/aa/rows",
        "critics/aa/rows",
        "evaluate//rows",
    ],
)
def test_a_pack_with_anything_but_files_of_artifacts_is_refused(tmp_path, member):
    (tmp_path / "packs").mkdir()
    (tmp_path / "packs/mine.tar.xz").write_bytes(lzma.compress(tar_of({member: b"bad"})))
    with pytest.raises(
        ArtifactError, match=r"mine\.tar\.xz' is damaged: .*is no file of an artifact"
    ):
        Layout(tmp_path)
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize("cut", [0, 40, -20])
def test_a_pack_that_was_cut_or_is_none_is_damaged(root, cut):
    pack = next((root / "packs").glob("[!.]*"))
    (root / "packs" / f".{pack.name}").unlink()
    pack.write_bytes(
        pack.read_bytes()[:cut] if cut else b"version https://git-lfs.github.com/spec/v1\n"
    )
    with pytest.raises(ArtifactError, match="is damaged"):
        unpack(root)


def test_a_pack_that_stands_for_more_than_fits_is_refused(root, monkeypatch):
    monkeypatch.setattr(packs, "LARGEST", 4096)
    next((root / "packs").glob(".*")).unlink()
    with pytest.raises(ArtifactError, match="has more than"):
        unpack(root)


@pytest.mark.parametrize("link", ["store", "store/evaluate"])
def test_a_link_in_the_place_of_the_store_leads_nowhere(root, tmp_path, link):
    clone, elsewhere = cloned(root, tmp_path / "clone"), tmp_path / "elsewhere"
    elsewhere.mkdir()
    shutil.rmtree(clone / "store")
    (clone / link).parent.mkdir(exist_ok=True)
    (clone / link).symlink_to(elsewhere)
    with pytest.raises(ArtifactError, match="leads elsewhere by a link"):
        unpack(clone)
    assert not list(elsewhere.iterdir())


def test_a_link_in_a_pack_is_refused(tmp_path):
    raw = io.BytesIO()
    with tarfile.open(fileobj=raw, mode="w") as archive:
        entry = tarfile.TarInfo("evaluate/aa/rows")
        entry.type, entry.linkname = tarfile.SYMTYPE, "/etc/hostname"
        archive.addfile(entry)
    (tmp_path / "packs").mkdir()
    (tmp_path / "packs/mine.tar.xz").write_bytes(lzma.compress(raw.getvalue()))
    with pytest.raises(ArtifactError, match="is damaged"):
        unpack(tmp_path)


def test_where_nobody_may_write_a_copy_is_unpacked(root, tmp_path, monkeypatch):
    package = cloned(root, tmp_path / "package" / "published")
    monkeypatch.setattr(shipped, "_PACKAGE", package.parent)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert shipped.published_folder() == package
    monkeypatch.setattr(os, "access", lambda *_: False)
    copy = shipped.published_folder()
    assert copy is not None
    assert copy.is_relative_to(tmp_path / "cache" / "wasp")
    assert shipped.published_folder() == copy
    assert files(Layout(copy).root) == files(root)
    assert list(files(package)) == ["store/critics/dd/w"]


def test_a_full_disk_is_told(root, monkeypatch):
    next((root / "packs").glob(".*")).unlink()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(StoreError, match=r"cannot unpack .*no space left"):
        unpack(root)


def test_what_is_published_goes_into_a_pack_of_its_own_and_a_clone_computes_nothing(
    here, computed, small_spec, tmp_path
):
    layer = here / "published"
    (layer / "packs").mkdir()
    shutil.rmtree(layer / "store")
    publish(small_spec, Layout(computed / "elsewhere"), Layout(layer))
    assert len(list((layer / "packs").glob("small-*.tar.xz"))) == 1
    clone = cloned(layer, tmp_path / "clone" / "published")
    assert not list(clone.glob("store/evaluate"))
    assert not plan(small_spec, clone.parent).to_run()
    run(small_spec, clone.parent)
    assert files(clone) == files(layer)


def test_everything_that_git_leaves_to_packs_is_in_one():
    assert write_pack(SHIPPED, "forgotten") is None, (
        "wasp publish packs what it adds; commit the pack"
    )
    ignored = (SHIPPED.parents[1] / ".gitignore").read_text().splitlines()
    assert {
        line.split("/")[-2] for line in ignored if line.startswith("results/published/store/")
    } == set(KINDS)
