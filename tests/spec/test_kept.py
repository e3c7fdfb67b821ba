"""What is kept between runs is whole, or as if it were not there, whoever writes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.commands import ROOT
from wasp_cli.spec import kept

NAME, VERSION = "numbers", "1"
VALUES = {"a": [1, 0.1], "b": None, "ü": "x" * 5000}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    return tmp_path / "wasp" / "kept"


def kept_file(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def test_values_come_back_as_they_were():
    kept.keep(NAME, VERSION, VALUES)
    assert kept.read_kept(NAME, VERSION) == VALUES
    kept.forget(NAME, VERSION)
    assert kept.read_kept(NAME, VERSION) == {}


def test_bytes_come_back_as_they_were_or_not_at_all(folder):
    content = bytes(range(256)) * 20
    assert kept.read_kept_bytes(NAME, VERSION) is None
    kept.keep_bytes(NAME, VERSION, content)
    assert kept.read_kept_bytes(NAME, VERSION) == content
    assert kept.read_kept_bytes(NAME, "2") is None
    path = kept_file(folder)
    whole = path.read_bytes()
    for damage in (b"", whole[:-1], whole.replace(b"\x07", b"\x08", 1), b"\n" + whole):
        path.write_bytes(damage)
        assert kept.read_kept_bytes(NAME, VERSION) is None


def test_another_version_has_its_own_values():
    kept.keep(NAME, VERSION, VALUES)
    assert kept.read_kept(NAME, "2") == {}


def test_a_damaged_file_is_as_if_there_were_none(folder):
    kept.keep(NAME, VERSION, VALUES)
    path = kept_file(folder)
    whole = path.read_bytes()
    damages = [
        b"",
        whole[: len(whole) // 2],
        whole[:-1],
        whole.replace(b"0.1", b"0.2"),
        b"\xff" + whole,
        b"[" * 100_000,
        json.dumps(VALUES).encode(),
    ]
    for damage in damages:
        path.write_bytes(damage)
        assert kept.read_kept(NAME, VERSION) == {}
    path.unlink()
    path.mkdir()
    assert kept.read_kept(NAME, VERSION) == {}
    kept.keep(NAME, VERSION, VALUES)  # a folder is in the way: nothing is kept
    path.rmdir()
    kept.keep(NAME, VERSION, VALUES)
    assert kept.read_kept(NAME, VERSION) == VALUES


def test_a_link_is_not_followed(folder, tmp_path):
    kept.keep(NAME, VERSION, VALUES)
    path = kept_file(folder)
    elsewhere = path.rename(tmp_path / "elsewhere")
    path.symlink_to(elsewhere)
    assert kept.read_kept(NAME, VERSION) == {}


def test_files_that_nobody_wrote_for_long_are_removed(folder):
    kept.keep("former", VERSION, VALUES)
    long_ago = time.time() - (kept.UNUSED_DAYS + 1) * 24 * 3600
    os.utime(kept_file(folder), (long_ago, long_ago))
    kept.keep(NAME, VERSION, VALUES)
    assert kept.read_kept(NAME, VERSION) == VALUES
    assert len(list(folder.iterdir())) == 1


WRITER = """
import sys
from wasp_cli.spec import kept
while True:
    kept.keep("numbers", "1", {"writer": sys.argv[1], "values": [sys.argv[1]] * 50_000})
"""


def test_readers_see_one_writer_whole_also_where_writers_are_killed(folder):
    seen = set()
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, name], cwd=ROOT) for name in ("one", "two")
    ]
    try:
        end = time.monotonic() + 120
        while len(seen) < 2 and time.monotonic() < end:
            values = kept.read_kept(NAME, VERSION)
            if values:
                assert set(values["values"]) == {values["writer"]}
                seen.add(values["writer"])
    finally:
        for writer in writers:
            writer.send_signal(signal.SIGKILL)
            writer.wait()
    assert seen == {"one", "two"}
    values = kept.read_kept(NAME, VERSION)
    assert len(values["values"]) == 50_000
    kept.keep(NAME, VERSION, VALUES)
    assert kept.read_kept(NAME, VERSION) == VALUES
