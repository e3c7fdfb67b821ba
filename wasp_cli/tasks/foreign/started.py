"""Processes that environments start, such as a simulator: they end with the process that runs the
environments, also where that is killed and nobody is left to close them.

They are known by a mark in their environment variables, and a guard ends them (see `guard`).
"""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

MARK = "WASP_ENVIRONMENTS_OF"  # the environment variable
_GUARD = Path(__file__).with_name("guard.py")


@dataclass(frozen=True)
class _Guarded:
    pid: int  # of the process whose environments are guarded
    mark: str
    pipe: IO[bytes] | None  # the guard sees its end; None where it could not be started


_guarded: _Guarded | None = None
_session = 0  # the session of this process, where all of it is to be ended
_blocks = 0  # blocks of `marking` that are open


def lead_session() -> None:
    """Leave the terminal of the process that started this one, so that a Ctrl-C there does not end
    this process. All that this process starts, and that stays in its session, is guarded.
    """
    global _session
    with suppress(PermissionError):  # it leads one already
        os.setsid()
    _session = os.getpid()


@contextmanager
def marking() -> Iterator[None]:
    """Let `mark` take effect in the block, and be taken back at its end."""
    global _blocks
    before = os.environ.get(MARK)
    _blocks += 1
    try:
        yield
    finally:
        _blocks -= 1
        _set(before)


def mark() -> None:
    """Begin to mark and to guard what this process starts. Outside of `marking` it does nothing:
    in somebody else's program, a notebook, it may start what has to stay.
    """
    if _blocks:
        _set(_guard().mark)


@contextmanager
def unmarked() -> Iterator[None]:
    """Start in the block what is to outlive this process, such as a browser."""
    before = os.environ.get(MARK)
    _set(None)
    try:
        yield
    finally:
        _set(before)


def _set(value: str | None) -> None:
    # only where it changes: other threads may read the variables
    if value == os.environ.get(MARK):
        return
    if value is None:
        del os.environ[MARK]
    else:
        os.environ[MARK] = value


def _guard() -> _Guarded:
    """The guard of this process, started when it is first asked for."""
    global _guarded
    if _guarded is None or _guarded.pid != os.getpid():
        pid = os.getpid()
        made = f"{pid}-{secrets.token_hex(8)}"
        _guarded = _Guarded(pid, made, _started_guard(pid, made))
    return _guarded


def _started_guard(pid: int, made: str) -> IO[bytes] | None:
    # -P: it must not import what lies beside it, or in the working directory
    group = pid if os.getpgrp() == pid else 0
    place = [str(_session), str(group)]
    command = [sys.executable, "-P", str(_GUARD), str(pid), f"{MARK}={made}", *place]
    # the mark of whoever started this process is not for its guard
    variables = {name: value for name, value in os.environ.items() if name != MARK}
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd="/",
            env=variables,
            start_new_session=True,
        )
    except OSError:  # no memory, no process: environments are closed all the same
        return None
    process.wait()  # it goes on in a fork of its own
    return process.stdin


def _forget_in_fork() -> None:
    """A fork of this process must not keep the guard waiting."""
    if _guarded is not None and _guarded.pipe is not None:
        _guarded.pipe.close()


os.register_at_fork(after_in_child=_forget_in_fork)
