"""Processes that are started in a worker, or in a run, begin with the signals of any other."""

import multiprocessing
import os
import signal
import subprocess
from concurrent.futures import Executor
from pathlib import Path

import pytest

from wasp_cli.run.pools.local import _new_workers
from wasp_cli.run.signals import SIGNALS, signals_wait
from wasp_cli.run.stop import Stop, listening

SLEEP = ["sleep", "600"]


@pytest.fixture(scope="module")
def worker():
    workers = _new_workers(1)
    with signals_wait():
        workers.submit(int).result()
    yield workers
    workers.shutdown(kill_workers=True)


def in_worker(worker: Executor, function, *arguments):
    return worker.submit(function, *arguments).result(timeout=600)


def signals_of(pid: int) -> dict[str, set[int]]:
    """Ignored and blocked signals of a process, by the name of Linux."""
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    masks = dict(line.split(":\t") for line in lines if line.startswith(("SigIgn", "SigBlk")))
    return {
        name: {number for number in SIGNALS if int(mask, 16) >> (number - 1) & 1}
        for name, mask in masks.items()
    }


def started_signals() -> dict[str, set[int]]:
    with subprocess.Popen(SLEEP) as process:
        found = signals_of(process.pid)
        process.kill()
    return found


def terminated_and_waited_for(number: int) -> int:
    process = subprocess.Popen(SLEEP)
    process.send_signal(number)
    return process.wait()


def fork_terminated_and_waited_for() -> int | None:
    process = multiprocessing.get_context("fork").Process(target=signal.pause)
    process.start()
    process.terminate()
    process.join()
    return process.exitcode


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells it")
def test_a_child_of_a_worker_ignores_and_holds_back_nothing(worker):
    assert in_worker(worker, started_signals) == {"SigIgn": set(), "SigBlk": set()}


@pytest.mark.parametrize("number", SIGNALS)
def test_a_child_of_a_worker_ends_when_it_is_asked_to(worker, number):
    assert in_worker(worker, terminated_and_waited_for, number) == -number


def test_a_fork_of_a_worker_ends_when_it_is_asked_to(worker):
    assert in_worker(worker, fork_terminated_and_waited_for) == -signal.SIGTERM


def test_a_worker_lives_through_them_and_a_terminal_does_not_reach_it(worker):
    pid = in_worker(worker, os.getpid)
    for number in SIGNALS:
        os.kill(pid, number)
    assert in_worker(worker, os.getpid) == pid
    assert os.getsid(pid) == os.getpgid(pid) == pid


def test_a_fork_of_a_run_that_listens_does_not_stop_the_run(tmp_path):
    stop = Stop(tmp_path / "stop", lambda: None)
    with listening(stop):
        assert fork_terminated_and_waited_for() == -signal.SIGTERM
    assert not stop.asked
    assert not (tmp_path / "stop").exists()
