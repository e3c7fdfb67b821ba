"""Who computes what: one lock file a node, held by the process that computes it.

The kernel releases a lock however its process ends: no lock is ever left over, and neither a clock
nor a process id has to be trusted.
"""

from __future__ import annotations

import errno
import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

POLL_SECONDS = 0.2
_PLAIN = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
# what a file system answers that has no locks
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


class Busy(Exception):
    """Someone else holds a lock, and it was not waited for."""


@contextmanager
def held(path: Path, waiting: Callable[[], bool], *, shared: bool = False) -> Iterator[None]:
    """Hold a lock for the block. While someone else holds it, `waiting` is called about five times
    a second; it returns whether to go on waiting.

    Any number of processes may hold it `shared`; then nobody holds it alone.

    The file stays. Only `remove_lock` removes one, while holding it. So a lock counts only if,
    once it is held, its file is still the one at the path: otherwise two processes could hold two
    files of one name.

    Raises:
        Busy: someone else holds it, and `waiting` returned False.
        OSError: the file cannot be opened.
    """
    how = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    while True:
        descriptor = _opened(path)
        try:
            while not _taken(descriptor, how):
                if not waiting():
                    raise Busy
                time.sleep(POLL_SECONDS)
            if _is_at(descriptor, path):
                yield
                return
        finally:
            os.close(descriptor)


@contextmanager
def held_if_free(path: Path) -> Iterator[bool]:
    """Hold a lock for the block unless someone else holds it; the value is whether it is held."""
    descriptor = _opened(path)
    try:
        yield _taken(descriptor) and _is_at(descriptor, path)
    finally:
        os.close(descriptor)


def is_held(path: Path) -> bool:
    """Return whether some process holds a lock now."""
    try:
        descriptor = os.open(path, os.O_RDONLY | _PLAIN)
    except FileNotFoundError:
        return False
    try:
        # Shared: for an exclusive lock NFS wants a file that is open for writing.
        return not (_taken(descriptor, fcntl.LOCK_SH) and _is_at(descriptor, path))
    finally:
        os.close(descriptor)


def remove_lock(path: Path) -> bool:
    """Remove a lock file unless someone holds it; return whether it was removed."""
    if not path.exists():
        return False
    with held_if_free(path) as mine:
        if mine:
            path.unlink()
        return mine


def _opened(path: Path) -> int:
    """The file of a lock, made where there is none."""
    # and not the results folder: one that was moved away is not made again
    path.parent.mkdir(exist_ok=True)
    return os.open(path, os.O_RDWR | os.O_CREAT | _PLAIN, 0o666)


def _taken(descriptor: int, how: int = fcntl.LOCK_EX) -> bool:
    """Take the lock of an open file, unless someone else holds it; return whether it is taken."""
    try:
        fcntl.flock(descriptor, how | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        # Two runs may then compute a node twice; what they publish is the same, and appears in one
        # step.
    return True


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is the one that a path names now."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(descriptor), os.stat(path, follow_symlinks=False))
    return False
