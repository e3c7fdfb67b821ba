"""What processes tell each other over a socket: a JSON value, and arrays by name behind it.

Nothing is pickled: an object array does not travel.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]


class Stream(Protocol):
    """What a socket gives as a file to read and write."""

    def readline(self) -> bytes:
        """Return the next line, with its end; nothing where the other side is gone."""
        ...

    def read(self, size: int, /) -> bytes:
        """Return that many bytes, or fewer where the other side is gone."""
        ...

    def write(self, data: bytes, /) -> int:
        """Take bytes to be sent, and return how many."""
        ...

    def flush(self) -> None:
        """Send what was taken."""
        ...


def send(stream: Stream, value: object, arrays: Arrays | None = None) -> None:
    """Tell a JSON value and arrays.

    Raises:
        OSError: nobody listens.
        TypeError: an array holds Python's objects.
    """
    told = dict(arrays or {})
    for name, array in told.items():
        if array.dtype.hasobject:
            raise TypeError(f"'{name}' is an array of Python's objects, not of numbers")
    shapes = [[name, array.shape, array.dtype.str] for name, array in told.items()]
    stream.write(json.dumps([value, shapes]).encode() + b"\n")
    for array in told.values():
        stream.write(array.tobytes())
    stream.flush()


def receive(stream: Stream) -> tuple[Any, dict[str, NDArray[Any]]]:
    """Wait for what is told next, and return the value and the arrays.

    Raises:
        EOFError: the other end is closed.
        OSError: it is gone.
    """
    line = stream.readline()
    if not line.endswith(b"\n"):
        raise EOFError
    value, shapes = json.loads(line)
    arrays: dict[str, NDArray[Any]] = {}
    for name, shape, kind in shapes:
        dtype = np.dtype(kind)
        size = int(np.prod(shape)) * dtype.itemsize
        content = stream.read(size)
        if len(content) < size:
            raise EOFError
        arrays[name] = np.frombuffer(content, dtype).reshape(shape).copy()
    return value, arrays
