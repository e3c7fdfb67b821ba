"""Reading small files of a results folder, which may be untrusted.

What is read is a plain file, no link, pipe or device, and fits into memory. Its strings have no
control characters for a terminal, and its values are not nested too deep for a recursive function.
"""

from __future__ import annotations

import errno
import io
import json
import os
import re
import stat
from contextlib import suppress
from pathlib import Path
from typing import Any

# bytes of a record or a journal at most; the plan of ten thousand nodes has four million
LARGEST = 256 * 2**20
DEEPEST = 40  # how deep a record may be nested; ours stay below ten
LONGEST = 308  # digits of a whole number at most: no float holds more

_UNPRINTABLE = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters (a terminal obeys them), changes of the reading direction, and halves of
characters (no stream takes them).
"""


def open_plain(path: Path) -> io.BufferedReader:
    """Return a plain file, open for reading. Raises OSError where it is a link, or no regular
    file.
    """
    try:
        # Without waiting: a pipe in the place of a file would otherwise hold the reader for ever.
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, "it is a link", str(path)) from error
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return open(descriptor, "rb")


def read_plain(path: Path) -> str:
    """Return the text of a plain file. Raises OSError as `open_plain` does, or where it is too
    large; ValueError where it is not UTF-8.
    """
    with open_plain(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > LARGEST:
            raise OSError(errno.EFBIG, f"it is too large ({size} bytes)", str(path))
        return file.read(LARGEST).decode("utf-8")


def parse(text: str) -> Any:
    """Return the value of a JSON text, its strings printable. Raises ValueError where it is no
    JSON, has a number with too many digits, or is nested too deep; RecursionError for some.
    """
    value = json.loads(text, parse_int=_whole)
    # Most texts are harmless, which is seen faster than every value is visited.
    is_shallow = text.count("{") + text.count("[") <= DEEPEST
    is_printable = "\\u" not in text and not _UNPRINTABLE.search(text)
    return value if is_shallow and is_printable else _tame(value, 0)


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """Return the objects of a file that has one in a line. Lines that are cut off, as a killed
    process leaves them, or are something else are left out. Raises OSError as `read_plain` does.
    """
    try:
        lines = read_plain(path).split("\n")  # JSON leaves rarer line ends in a text as they are
    except ValueError:
        return []
    objects = []
    for line in lines:
        with suppress(ValueError, RecursionError):
            value = parse(line)
            if isinstance(value, dict):
                objects.append(value)
    return objects


def append_line(descriptor: int, text: str) -> None:
    """Append a line to a file that is open for reading and appending, in one write as long as the
    disk has room.

    Where an earlier write was not finished, its part stays a line of its own.
    """
    size = os.fstat(descriptor).st_size
    is_whole = not size or os.pread(descriptor, 1, size - 1) == b"\n"
    rest = text.encode() + b"\n"
    if not is_whole:
        rest = b"\n" + rest
    while rest:  # a full disk takes a part, and refuses the rest
        rest = rest[os.write(descriptor, rest) :]


def printable(text: str) -> str:
    """Return a text with a replacement character for every control character."""
    return _UNPRINTABLE.sub("\ufffd", text)


def _whole(digits: str) -> int:
    """A whole number, which takes quadratic time to read."""
    if len(digits) > LONGEST:
        raise ValueError(f"it has a number of {len(digits)} digits")
    return int(digits)


def _tame(value: Any, depth: int) -> Any:
    """A value with all its strings printable; ValueError where it is nested too deep."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict | list) and depth >= DEEPEST:
        raise ValueError(f"it is nested more than {DEEPEST} deep")
    if isinstance(value, dict):
        return {printable(name): _tame(part, depth + 1) for name, part in value.items()}
    if isinstance(value, list):
        return [_tame(part, depth + 1) for part in value]
    return value
