"""Small files that others have written."""

import errno
import fcntl
import json
import multiprocessing
import os
import threading
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.store.test_tables import CELL, invent
from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.metrics.episode import episode_metrics
from wasp_cli.store.artifact import (
    commit,
    damage,
    discard,
    is_file_name,
    read_manifest,
    staging_folder,
    stored_keys,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held, held_if_free, is_held, remove_lock
from wasp_cli.store.plain import DEEPEST, parse, read_json_lines, read_plain
from wasp_cli.store.recorded import read_recorded
from wasp_cli.store.records import read_record
from wasp_cli.store.tables import STEPS_FILE, Thresholds, write_cell

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
    said = (
        parse(json.dumps({"a" + bad: [bad]}))
        if escaped or bad < " "
        else parse(json.dumps({"a" + bad: [bad]}, ensure_ascii=False))
    )
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


@pytest.mark.parametrize(
    "name", ["", "/etc/passwd", "..", "../x", "a/../../x", "a//b", "./a", "a\0", "a" * 5000]
)
def test_an_artifact_has_no_files_elsewhere(name):
    assert not is_file_name(name)
    assert is_file_name("deep/data.bin")


@pytest.fixture
def layout(layout) -> Layout:
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


# Locks whose files are removed meanwhile.


def nothing() -> bool:
    return True


def test_a_file_that_nobody_holds_goes(tmp_path):
    path = tmp_path / "key"
    assert not remove_lock(path)
    with held(path, nothing):
        assert not remove_lock(path)
        assert path.exists()
    assert remove_lock(path)
    assert not path.exists()


def test_locks_are_asked_for_as_nfs_allows(tmp_path, monkeypatch):
    real = fcntl.flock

    def flock(descriptor: int, how: int) -> None:
        if (
            how & fcntl.LOCK_EX
            and fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY
        ):
            raise OSError(errno.EBADF, "an exclusive lock of a file that is open for reading")
        real(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    assert not is_held(tmp_path / "key")
    with held(tmp_path / "key", nothing):
        assert is_held(tmp_path / "key")
    assert not is_held(tmp_path / "key")
    assert remove_lock(tmp_path / "key")


def test_who_waits_for_a_file_that_goes_holds_the_new_one(tmp_path):
    """Without looking again, it would hold a file that no path names, and the next process
    another one.
    """
    path = tmp_path / "key"
    waits, holds, end = threading.Event(), threading.Event(), threading.Event()

    def wait_and_hold() -> None:
        with held(path, lambda: waits.set() is None):
            holds.set()
            end.wait(600)

    with held(path, nothing):
        waiter = threading.Thread(target=wait_and_hold)
        waiter.start()
        assert waits.wait(600)
        path.unlink()
    assert holds.wait(600)
    assert is_held(path)
    assert not remove_lock(path)
    end.set()
    waiter.join()


def count_up(lock: str, counter: str, times: int) -> None:
    for _ in range(times):
        with held(Path(lock), nothing):
            number = int(Path(counter).read_text())
            os.sched_yield()
            Path(counter).write_text(str(number + 1))


def test_one_at_a_time_although_the_file_is_removed_all_the_time(tmp_path):
    counter = tmp_path / "counter"
    counter.write_text("0")
    context = multiprocessing.get_context("fork")  # it has imported everything already
    processes = [
        context.Process(target=count_up, args=(str(tmp_path / "key"), str(counter), 40))
        for _ in range(2)
    ]
    for process in processes:
        process.start()
    removed = 0
    while any(process.is_alive() for process in processes):
        removed += remove_lock(tmp_path / "key")
    assert [process.exitcode for process in processes] == [0, 0]
    assert counter.read_text() == "80"
    assert removed > 1


def test_some_share_a_lock_and_nobody_then_has_it_alone(tmp_path):
    path = tmp_path / "planning"
    with (
        held(path, nothing, shared=True),
        held(path, lambda: pytest.fail("a shared lock is shared"), shared=True),
        held_if_free(path) as mine,
    ):
        assert not mine
    with held_if_free(path) as mine:
        assert mine
        assert is_held(path)


EPISODES = [invent(0, 5), invent(1, 1), invent(2, 9)]


@pytest.fixture
def path(tmp_path) -> Path:
    rows = [episode_metrics(trajectory, 3, 25.0) for trajectory in EPISODES]
    return write_cell(
        tmp_path,
        CELL,
        EPISODES,
        rows,
        Thresholds(),
        [np.ones(t.steps) for t in EPISODES],
        [11, 12, 13],
    )


def test_commands_actions_and_rewards_come_back_episode_by_episode(path):
    recorded = read_recorded(path)
    assert recorded["layouts"] == [11, 12, 13]
    for e, trajectory in enumerate(EPISODES):
        for name in ("a_h", "a", "reward"):
            assert recorded[name][e].dtype == np.float32
            np.testing.assert_array_equal(
                recorded[name][e], getattr(trajectory, name).astype(np.float32)
            )


@pytest.mark.parametrize(
    "damage", ["no episode", "an episode is missing", "steps are missing", "no actions"]
)
def test_rows_that_are_no_whole_episodes_are_refused(path, damage):
    table = pq.read_table(path)
    if damage == "no episode":
        table = table.slice(0, 0)
    elif damage == "an episode is missing":
        table = pa.concat_tables([table.slice(0, 1), table.slice(2, 1)])
    elif damage == "steps are missing":
        table = table.set_column(
            table.column_names.index("decisions"),
            table.schema.field("decisions"),
            [pa.array([5, 2, 9], pa.int32())],
        )
    else:
        steps = pq.read_table(path.with_name(STEPS_FILE))
        rows = [step | {"a": []} for step in steps.to_pylist()]
        pq.write_table(pa.Table.from_pylist(rows, schema=steps.schema), path.with_name(STEPS_FILE))
    pq.write_table(table, path)
    with pytest.raises(StoreError, match=r"whole episodes|'a' is missing"):
        read_recorded(path)
