"""`wasp publish --archive`: a folder for an archive, whose sums hold, and from which rows are read again."""

import hashlib
import shutil
import tarfile
from pathlib import Path

import pytest

from wasp_cli.errors import StoreError, UsageError
from wasp_cli.notebook.results import open_results
from wasp_cli.run.publish import write_archive
from wasp_cli.store.layout import Layout

PUBLISHED = Path(__file__).parents[2] / "results" / "published"
KEY = "ab95264a06906dcda61e"  # race1 s1 wasp laggy=0.7


@pytest.fixture
def target(tmp_path):
    shutil.copytree(PUBLISHED / "store/evaluate" / KEY, tmp_path / "published/store/evaluate" / KEY)
    (tmp_path / "published/reports/mine").mkdir(parents=True)
    (tmp_path / "published/reports/mine/report.md").write_text("# Report: mine\n")
    (tmp_path / "published/private").symlink_to("/etc/hostname")
    return Layout(tmp_path / "published")


def test_an_archive_has_sums_that_hold_a_licence_and_a_card_and_is_read_again(target, tmp_path):
    file = tmp_path / "mine-1.0.tar.gz"
    count = write_archive(target, "mine", file)
    with tarfile.open(file) as archive:
        assert len(archive.getnames()) == count
        archive.extractall(tmp_path / "unpacked", filter="data")
    root = tmp_path / "unpacked/mine-1.0"
    lines = (root / "SHA256SUMS").read_text().splitlines()
    assert {line.split("  ")[1] for line in lines} | {"SHA256SUMS"} == {str(p.relative_to(root)) for p in root.rglob("*") if p.is_file()}
    for line in lines:
        digest, name = line.split("  ")
        assert hashlib.sha256((root / name).read_bytes()).hexdigest() == digest
    card = (root / "README.md").read_text()
    assert card.startswith("---\nlicense: apache-2.0\n")
    assert "| evaluate | 1 | race1 |" in card
    assert "Apache License" in (root / "LICENSE").read_text()
    assert not (root / "private").exists()
    assert open_results(root).episodes().num_rows == 30


def test_the_same_folder_gives_the_same_bytes_and_nothing_is_overwritten(target, tmp_path):
    first, second = tmp_path / "a/mine.tar.gz", tmp_path / "b/mine.tar.gz"
    for file in (first, second):
        file.parent.mkdir()
        write_archive(target, "mine", file)
    assert first.read_bytes() == second.read_bytes()
    for name in ("mine.tar.gz", "mine.zip"):
        with pytest.raises(UsageError):
            write_archive(target, "mine", tmp_path / "a" / name)
    with pytest.raises(StoreError):
        write_archive(Layout(tmp_path / "none"), "mine", tmp_path / "c.tar.gz")
