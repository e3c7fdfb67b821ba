"""Who computes what: one lock file a node, held by the process that computes it.

The kernel releases a lock however its process ends, so that no lock is ever stale and no clock or process id has to be trusted.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def held(path: Path, waiting: Callable[[], None]) -> Iterator[None]:
    """Hold a lock; `waiting` is called once if someone else has it.

    The file stays. Only `remove_lock` removes one, and that while it holds it: so a lock counts when, once held, its file is still the
    one that the path names. Otherwise two processes could hold two files of one name.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    told = False
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            if not _taken(descriptor):
                if not told:
                    told = True
                    waiting()
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            if _is_at(descriptor, path):
                yield
                return
        finally:
            os.close(descriptor)


def is_held(path: Path) -> bool:
    """Whether some process holds a lock now."""
    while (descriptor := _opened(path)) is not None:
        try:
            if not _taken(descriptor):
                return True
            if _is_at(descriptor, path):
                return False
        finally:
            os.close(descriptor)
    return False


def remove_lock(path: Path) -> bool:
    """Remove a lock file unless someone holds it; whether it is removed."""
    descriptor = _opened(path)
    if descriptor is None:
        return False
    try:
        if not _taken(descriptor) or not _is_at(descriptor, path):
            return False
        path.unlink()
        return True
    finally:
        os.close(descriptor)


def _opened(path: Path) -> int | None:
    """The file of a lock; None where there is none."""
    try:
        return os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        return None


def _taken(descriptor: int) -> bool:
    """Take the lock of an open file if nobody has it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is the one that a path names now."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path, follow_symlinks=False))
    except FileNotFoundError:
        return False
