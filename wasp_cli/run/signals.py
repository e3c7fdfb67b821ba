"""How a run is stopped: the first Ctrl-C lets it finish what runs, the second ends it at once. SIGTERM counts as Ctrl-C does."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """Whether a run was asked to stop. Workers learn it from a file, on other machines too."""

    def __init__(self, path: Path, told: Callable[[], None]) -> None:
        self._path, self._told = path, told
        self.asked = False

    def ask(self) -> None:
        """Let nothing new begin.

        Raises:
            KeyboardInterrupt: it was asked before.
        """
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        with suppress(OSError):
            self._path.touch()
        self._told()


@contextmanager
def listening(stop: Stop) -> Iterator[None]:
    """Turn signals into requests to stop. One that this process was started to ignore (`nohup`) stays ignored."""

    def ask(number: int, frame: object) -> None:
        stop.ask()

    before = {number: signal.getsignal(number) for number in SIGNALS}
    taken = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    try:
        for number in taken:
            signal.signal(number, ask)
        yield
    finally:
        for number in taken:
            signal.signal(number, before[number])
