"""A program of its own: python guard.py PID NAME=VALUE SESSION GROUP. It waits until the process
PID is gone, however it went, and then ends what the environments of that process have started and
left.

These are the processes with the environment variable NAME=VALUE; those of the session SESSION,
where that is not 0; and those of the process group GROUP, where that is not 0, that began after
this guard: a shell may have put others into the group before (`wasp run spec.yaml | tee log`). The
guard goes on in a fork that is nobody's child, so that who ends PID with its children does not end
it too.
"""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import psutil

LOOK_SECONDS = 2.0  # between two looks, where nothing tells that the process is gone
SOON_SECONDS = 0.1
GRACE_SECONDS = 2.0  # from SIGTERM to SIGKILL
ROUNDS = 10  # what is ended may start others meanwhile


def is_alive(process: psutil.Process) -> bool:
    """Return whether a process runs; a zombie, which has ended and was not waited for, does not."""
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


@dataclass(frozen=True)
class Left:
    """How to find the processes that a process has started and left."""

    variable: str  # NAME=VALUE
    session: int  # 0: none
    group: int  # 0: none
    began: float  # when the guard began, in seconds since 1970

    def has(self, process: psutil.Process) -> bool:
        """Return whether a process is one of them. Raises psutil.Error or OSError where it has
        ended meanwhile, or is another user's.
        """
        if self.session and os.getsid(process.pid) == self.session:
            return True
        is_later = process.create_time() >= self.began
        if self.group and is_later and os.getpgid(process.pid) == self.group:
            return True
        name, _, value = self.variable.partition("=")
        return bool(process.environ().get(name) == value)

    def find(self) -> Iterator[psutil.Process]:
        """Yield those that are alive."""
        for process in psutil.process_iter():
            with suppress(psutil.Error, OSError):
                if process.pid != os.getpid() and is_alive(process) and self.has(process):
                    yield process


def end_all(left: Left) -> None:
    """End them: first they are asked to, then killed."""
    for _ in range(ROUNDS):
        processes = list(left.find())
        if not processes:
            return
        for process in processes:
            with suppress(psutil.Error):
                process.terminate()
        _, unwilling = psutil.wait_procs(processes, timeout=GRACE_SECONDS)
        for process in unwilling:
            with suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(unwilling, timeout=GRACE_SECONDS)


def main() -> None:
    """Guard the process that the arguments name."""
    pid, variable, session, group = sys.argv[1:]
    left = Left(variable, int(session), int(group), psutil.Process().create_time())
    if os.fork():
        os._exit(0)
    wait_for_end(int(pid))
    end_all(left)


if __name__ == "__main__":
    main()
