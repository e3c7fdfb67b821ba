"""Small files that others have written."""

import json
import os

import pytest

from wasp_cli.errors import ArtifactError
from wasp_cli.store.artifact import commit, damage, discard, is_file_name, read_manifest, read_record, staging_folder, stored_keys
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import DEEPEST, parse, read_json_lines, read_plain

KEY = "a" * 20


def test_a_link_is_not_read(tmp_path):
    (tmp_path / "secret").write_text("{}")
    (tmp_path / "link").symlink_to(tmp_path / "secret")
    with pytest.raises(OSError, match="it is a link"):
        read_plain(tmp_path / "link")
    with pytest.raises(ArtifactError, match="it is a link"):
        read_record(tmp_path / "link")


def test_a_pipe_holds_nobody(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="not a regular file"):
        read_plain(tmp_path / "pipe")


def nested(depth: int) -> str:
    return '{"a": ' * depth + "1" + "}" * depth


def test_depth_has_an_end():
    assert parse(nested(DEEPEST)) == json.loads(nested(DEEPEST))
    for depth in (DEEPEST + 1, 900, 100_000):
        with pytest.raises((ValueError, RecursionError)):
            parse(nested(depth))
    wide = "[" + ", ".join(["[1]"] * 1000) + "]"
    assert len(parse(wide)) == 1000


@pytest.mark.parametrize("bad", ["\x1b]0;title\x07", "\x1b[31m", "\x9b31m", "\u202etxt", "\ud800"])
@pytest.mark.parametrize("escaped", [True, False])
def test_nothing_that_a_terminal_obeys_is_read(bad, escaped):
    said = parse(json.dumps({"a" + bad: [bad]})) if escaped or bad < " " else parse(json.dumps({"a" + bad: [bad]}, ensure_ascii=False))
    ((name, (value,)),) = said.items()
    for text in (name, value):
        assert bad not in text
        assert "\ufffd" in text
        text.encode()
    assert parse('{"a": "line\\nline\\t\\u00e9 \\u00b1"}') == {"a": "line\nline\té ±"}


def test_lines_that_are_no_objects_are_left_out(tmp_path):
    path = tmp_path / "lines"
    path.write_text('{"a": 1}\n[1]\n7\n' + "[" * 100_000 + '\n{"b": 2}\n{"cut": ')
    assert read_json_lines(path) == [{"a": 1}, {"b": 2}]
    path.write_bytes(b"\xff\xfe")
    assert read_json_lines(path) == []


@pytest.mark.parametrize("name", ["", "/etc/passwd", "..", "../x", "a/../../x", "a//b", "./a", "a\0", "a" * 5000])
def test_an_artifact_has_no_files_elsewhere(name):
    assert not is_file_name(name)
    assert is_file_name("deep/data.bin")


@pytest.fixture
def layout(tmp_path) -> Layout:
    layout = Layout(tmp_path / "results")
    layout.prepare()
    staging = staging_folder(layout, KEY)
    (staging / "deep").mkdir()
    (staging / "deep" / "data").write_text("1")
    commit(layout, "expert", KEY, staging, {})
    return layout


def test_an_artifact_that_became_a_link_is_none(layout, tmp_path):
    place = layout.artifact("expert", KEY)
    place.rename(tmp_path / "elsewhere")
    place.symlink_to(tmp_path / "elsewhere")
    assert stored_keys(layout, "expert") == set()
    assert "is a link" in (damage(layout, "expert", KEY) or "")
    with pytest.raises(ArtifactError, match="is a link"):
        read_manifest(layout, "expert", KEY)
    staging = staging_folder(layout, KEY)
    (staging / "data").write_text("2")
    commit(layout, "expert", KEY, staging, {})
    assert damage(layout, "expert", KEY) is None
    assert (tmp_path / "elsewhere" / "deep" / "data").read_text() == "1"


@pytest.mark.parametrize("part", ["deep", "deep/data"])
def test_a_part_of_an_artifact_that_became_a_link_is_damage(part, layout, tmp_path):
    place = layout.artifact("expert", KEY)
    (place / part).rename(tmp_path / "elsewhere")
    (place / part).symlink_to(tmp_path / "elsewhere")
    assert damage(layout, "expert", KEY) is not None


def test_what_a_link_leads_to_is_not_discarded(tmp_path):
    (tmp_path / "precious").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "precious")
    for path in (tmp_path / "link", tmp_path / "absent"):
        discard(path)
    assert not (tmp_path / "link").exists()
    assert (tmp_path / "precious").is_dir()
