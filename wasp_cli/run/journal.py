"""The events of a run, appended one JSON object a line: what happened, also when the run did not live to tell."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from wasp_cli.store.plain import read_json_lines


class Journal:
    """Appends events to `journal.jsonl`. Each is one write, so that a signal handler may write one too, and lines never mix."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)

    def write(self, event: str, **facts: Any) -> None:
        """Append one event with its time. A full disk must not end the run that it keeps from telling."""
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        with suppress(OSError):
            os.write(self._file, (json.dumps({"at": now, "event": event, **facts}) + "\n").encode())

    def close(self) -> None:
        """Close the file; what is written afterwards goes nowhere."""
        file, self._file = self._file, -1
        os.close(file)


def read_journal(path: Path) -> list[dict[str, Any]]:
    """The events of a journal; a last line that a kill cut short is left out."""
    return read_json_lines(path)


class Tail:
    """The events that came to a journal since it was last asked."""

    def __init__(self, path: Path) -> None:
        self._path, self._position = path, 0

    def new(self) -> Iterator[dict[str, Any]]:
        """Whole new lines; the beginning of one is left for later."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._position)
                text = file.read()
        except FileNotFoundError:
            return
        whole, newline, _ = text.rpartition(b"\n")
        self._position += len(whole) + len(newline)
        for line in whole.splitlines():
            with suppress(ValueError):
                yield json.loads(line)
