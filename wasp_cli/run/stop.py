"""Ending a run early: Ctrl-C and SIGTERM ask it to stop, and a second one ends it at once."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from wasp_cli.run.signals import SIGNALS, handle


class Stop:
    """Whether a run was asked to stop. Workers see it by a file, on other machines too."""

    def __init__(self, path: Path, announce: Callable[[], None]) -> None:
        """`announce` is called when the run is first asked."""
        self._path = path
        self._announce = announce
        self.asked = False

    def ask(self) -> None:
        """Ask the run to stop after its running nodes. Raises KeyboardInterrupt if it was asked
        before.
        """
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        with suppress(OSError):
            self._path.touch()
        self._announce()


@contextmanager
def listening(stop: Stop) -> Iterator[None]:
    """Within the block, turn SIGINT and SIGTERM into requests to stop. A signal that this process
    was started to ignore (`nohup`) stays ignored.
    """

    def ask(number: int, frame: object) -> None:
        stop.ask()

    before = {number: signal.getsignal(number) for number in SIGNALS}
    handled = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    try:
        for number in handled:
            handle(number, ask)
        yield
    finally:
        for number in handled:
            signal.signal(number, before[number])
