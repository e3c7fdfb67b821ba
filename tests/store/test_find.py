from pathlib import Path
from typing import Any

import pytest

from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.find import find_cell
from wasp_cli.store.layout import Layout

KEYS = {
    "0123456789abcdef0123": "goal1 s0 wasp laggy=0.7",
    "0123ffffffffffffffff": "goal1 s0 wasp/no-case2 laggy=0.7",
    "aaaa0000000000000000": "goal1 s1 wasp laggy=0.7",
    "bbbb0000000000000000": "race1 s0 human noisy=0.4",
}


def store(
    layout: Layout,
    key: str,
    label: str,
    started_at: str = "2026-05-01T12:34:56+00:00",
    **further: Any,
) -> Path:
    staging = staging_folder(layout, key)
    (staging / "episodes.parquet").write_bytes(b"rows")
    manifest = {
        "key": key,
        "kind": "evaluate",
        "label": label,
        "provenance": {"started_at": started_at},
        **further,
    }
    return commit(layout, "evaluate", key, staging, manifest)


@pytest.fixture
def layout(layout) -> Layout:
    for key, label in KEYS.items():
        store(layout, key, label)
    return layout


@pytest.mark.parametrize("text", ["01234", "0123456789abcdef0123", "  01234 ", "012345678"])
def test_the_beginning_of_a_key(layout, text):
    found = find_cell(layout, text)
    assert found.key == "0123456789abcdef0123"
    assert found.path == layout.store / "evaluate" / "0123456789abcdef0123" / "episodes.parquet"
    assert (found.label, found.date) == ("goal1 s0 wasp laggy=0.7", "2026-05-01 12:34")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("goal1 s0 wasp laggy=0.7", "0123456789abcdef0123"),
        ("goal1 s0 wasp/no-case2 laggy=0.7", "0123ffffffffffffffff"),
        ("goal1  s1 wasp laggy=0.7 ", "aaaa0000000000000000"),
        ("Goal1 s1 WASP laggy=0.7", "aaaa0000000000000000"),
        ("goal1 wasp/no-case2 laggy=0.7 seed 0", "0123ffffffffffffffff"),  # as reports name it
    ],
)
def test_a_label(layout, text, key):
    assert find_cell(layout, text).key == key


def test_several_are_listed_newest_first(layout):
    store(layout, "cccc0000000000000000", "goal1 s0 wasp laggy=0.7", "2026-06-01T00:00:00+00:00")
    with pytest.raises(UsageError) as caught:
        find_cell(layout, "goal1 s0 wasp laggy=0.7")
    assert caught.value.exit_code == 2
    assert caught.value.message.splitlines() == [
        "'goal1 s0 wasp laggy=0.7' names 2 evaluations, newest first:",
        "  cccc0000000000000000  goal1 s0 wasp laggy=0.7  2026-06-01 00:00",
        "  0123456789abcdef0123  goal1 s0 wasp laggy=0.7  2026-05-01 12:34",
    ]
    with pytest.raises(UsageError, match="'0123' names 2 evaluations") as caught:
        find_cell(layout, "0123")
    assert "no-case2" in caught.value.message
    for i in range(20):
        store(layout, f"dddd{i:016x}", "race1 s0 human noisy=0.4")
    with pytest.raises(UsageError, match="and 8 more"):
        find_cell(layout, "dddd")


def test_paths(layout, tmp_path, monkeypatch):
    folder = layout.artifact("evaluate", "aaaa0000000000000000")
    for path in (folder, folder / "episodes.parquet", f"{folder}/"):
        found = find_cell(Layout(tmp_path / "nowhere"), str(path))
        assert (found.key, found.path) == ("aaaa0000000000000000", folder / "episodes.parquet")
    copy = tmp_path / "copy of a cell.parquet"
    copy.write_bytes(b"rows")
    alone = find_cell(layout, str(copy))
    assert (alone.key, alone.label, alone.date, alone.setting("axes", "method")) == (
        None,
        None,
        "",
        None,
    )
    monkeypatch.chdir(folder.parent.parent)
    assert (
        find_cell(Layout(Path("nowhere")), "evaluate/bbbb0000000000000000").key
        == "bbbb0000000000000000"
    )
    with pytest.raises(UsageError, match="holds no episodes"):
        find_cell(layout, str(tmp_path))


@pytest.mark.parametrize(
    "text",
    [
        "../../x",
        "../evaluate/0123456789abcdef0123/../x",
        "/etc/shadow/x",
        "\0",
        "x" * 5000,
        "",
        "  ",
        "~",
        "*",
    ],
)
def test_what_names_nothing_opens_nothing(layout, text):
    with pytest.raises(UsageError) as caught:
        find_cell(layout, text)
    assert caught.value.exit_code == 2


def test_suggestions(layout):
    with pytest.raises(UnknownName) as caught:
        find_cell(layout, "goal1 s0 wasp lagy=0.7")
    assert "did you mean 'goal1 s0 wasp laggy=0.7'" in str(caught.value.hint)
    with pytest.raises(UnknownName) as caught:
        find_cell(layout, "deadbeef")
    assert "give a key" in str(caught.value.hint)
    with pytest.raises(UsageError, match="too short for a key"):
        find_cell(layout, "012")
