"""Shared memory, which holds the semaphores of worker processes: on Linux as files in /dev/shm.

A container may have none, or one that is full or read-only. Then no worker process can start, and a
run computes in its own process.
"""

from __future__ import annotations

import multiprocessing
import sys
from typing import Any

from wasp_cli.errors import WaspError

PLACE = "/dev/shm"
# semaphores that loky makes for its queues and locks, beside one for each worker
NEEDED = 8
REMEDY = (
    f"mount a folder in memory at {PLACE} (docker run --shm-size=64m), or compute without worker "
    "processes: -j 1"
)


def refusal_of_semaphores(workers: int) -> str | None:
    """Return why the semaphores of this number of worker processes cannot be made; None if they
    can.
    """
    made: list[Any] = []
    try:
        # With "fork", a semaphore loses its name at once, and no process starts to track it.
        context = multiprocessing.get_context("fork")
        for _ in range(NEEDED + workers):
            made.append(context.Semaphore())
    except ImportError:
        return "this Python has no semaphores"
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        return f"'{PLACE}': {reason}" if sys.platform == "linux" else reason
    return None


def require_semaphores(workers: int) -> None:
    """Raise WaspError if this number of worker processes cannot be started."""
    reason = refusal_of_semaphores(workers)
    if reason is not None:
        raise WaspError(f"no worker process can be started: {reason}", REMEDY)
