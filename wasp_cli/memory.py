"""What is freed stays with the process."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # parameters of glibc's mallopt(3)
LARGEST = 32 * 1024**2  # blocks up to this size, in bytes, come from the heap; glibc allows no more
KEPT = 1024**3  # free bytes at the end of the heap that are not returned


def keep_memory() -> bool:
    """Let the C library keep what is freed instead of returning it to the system; whether it does.

    A planner allocates and frees the same megabytes hundreds of times per second. By default glibc returns them each time, and the system
    gives them back zeroed, page by page: up to a third of the time of a decision.
    """
    if sys.platform.startswith("linux"):
        with suppress(OSError, AttributeError):  # another C library than glibc
            library = ctypes.CDLL(None)
            return bool(library.mallopt(MMAP_THRESHOLD, LARGEST)) and bool(library.mallopt(TRIM_THRESHOLD, KEPT))
    return False
