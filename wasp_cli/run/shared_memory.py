"""Shared memory, where the semaphores of worker processes are: on Linux files in /dev/shm.

A container may have none, or one that is full or read only. No worker process starts there, and a
run computes in its own.
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
    """Return why the semaphores of so many worker processes cannot be made; None where they can
    be.
    """
    made: list[Any] = []
    try:
        # Of this kind a semaphore loses its name at once: no process that looks after it starts.
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
    """Raise WaspError where so many worker processes cannot be started."""
    reason = refusal_of_semaphores(workers)
    if reason is not None:
        raise WaspError(f"no worker process can be started: {reason}", REMEDY)
