"""Locks whose files are removed meanwhile."""

import multiprocessing
import os
import threading
from pathlib import Path

import pytest

from wasp_cli.store.lock import held, held_if_free, is_held, remove_lock


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


def test_who_waits_for_a_file_that_goes_holds_the_new_one(tmp_path):
    """Without looking again, it would hold a file that no path names, and the next process another one."""
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
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=count_up, args=(str(tmp_path / "key"), str(counter), 100)) for _ in range(2)]
    for process in processes:
        process.start()
    removed = 0
    while any(process.is_alive() for process in processes):
        removed += remove_lock(tmp_path / "key")
    assert [process.exitcode for process in processes] == [0, 0]
    assert counter.read_text() == "200"
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
