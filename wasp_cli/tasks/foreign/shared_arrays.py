"""Arrays that several processes see: one block of memory without a name, which is gone with the
last process that holds it.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

ALIGNMENT = 64  # bytes; where an array begins

Layout = Mapping[str, tuple[tuple[int, ...], str]]
"""Shape and type of each array, by name."""


def made_memory(layout: Layout) -> int:
    """Return the descriptor of a new block of memory, all zeros, in which some arrays have room.

    It has no place in /dev/shm, which containers may lack. Where the system has no such memory
    (macOS), it is a file of the temporary folder that has no name any more.
    """
    size = max(sum(_room(shape, dtype) for shape, dtype in layout.values()), ALIGNMENT)
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("wasp-environments", os.MFD_CLOEXEC)
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.truncate(descriptor, size)
    return descriptor


def arrays_in(descriptor: int, layout: Layout) -> dict[str, NDArray[Any]]:
    """Return the arrays that lie in a block of memory, by name; whoever writes into one writes
    into that of every process.
    """
    memory = mmap.mmap(descriptor, 0)
    arrays: dict[str, NDArray[Any]] = {}
    begin = 0
    for name, (shape, dtype) in layout.items():
        count = int(np.prod(shape))
        flat: NDArray[Any] = np.frombuffer(memory, dtype, count, begin)
        arrays[name] = flat.reshape(shape)
        begin += _room(shape, dtype)
    return arrays


def _room(shape: tuple[int, ...], dtype: str) -> int:
    """Bytes of an array, up to where the next one may begin."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return -(-size // ALIGNMENT) * ALIGNMENT
