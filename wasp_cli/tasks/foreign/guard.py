"""A program of its own: python guard.py PID NAME=VALUE SESSION. It waits until the process PID is
gone, however it went, and then ends what the environments of that process have started and left.

These are the processes with the environment variable NAME=VALUE, and those of the session SESSION
where that is not 0. The guard goes on in a fork that is nobody's child, so that who ends PID with
its children does not end it too.
"""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Iterator
from contextlib import suppress

import psutil

LOOK_SECONDS = 2.0  # between two looks, where nothing tells that the process is gone
SOON_SECONDS = 0.1
GRACE_SECONDS = 2.0  # from SIGTERM to SIGKILL
ROUNDS = 10  # what is ended may start others meanwhile


def is_alive(process: psutil.Process) -> bool:
    """Return whether a process runs; one that has ended and that nobody has asked for does not."""
    with suppress(psutil.NoSuchProcess):
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    return False


def wait_for_end(pid: int) -> None:
    """Wait until a process is gone. Standard input, of which it holds the other end, tells at once;
    a fork of it may hold that too.
    """
    try:
        process = psutil.Process(pid)
    except psutil.NoSuchProcess:
        return
    pause = LOOK_SECONDS
    while is_alive(process):
        if pause == LOOK_SECONDS and select.select([0], [], [], pause)[0]:
            pause = SOON_SECONDS
        elif pause == SOON_SECONDS:
            time.sleep(pause)


def left_behind(mark: str, session: int) -> Iterator[psutil.Process]:
    """Yield the processes that are to be ended."""
    name, _, value = mark.partition("=")
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if process.pid == os.getpid() or not is_alive(process):
                continue
            of_session = session != 0 and os.getsid(process.pid) == session
            if of_session or process.environ().get(name) == value:
                yield process


def end_all(mark: str, session: int) -> None:
    """End them: first they are asked to, then killed."""
    for _ in range(ROUNDS):
        found = list(left_behind(mark, session))
        if not found:
            return
        for process in found:
            with suppress(psutil.Error):
                process.terminate()
        _, unwilling = psutil.wait_procs(found, timeout=GRACE_SECONDS)
        for process in unwilling:
            with suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(unwilling, timeout=GRACE_SECONDS)


def main() -> None:
    pid, mark, session = int(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    if os.fork():
        os._exit(0)
    wait_for_end(pid)
    end_all(mark, session)


if __name__ == "__main__":
    main()
