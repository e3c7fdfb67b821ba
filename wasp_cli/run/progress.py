"""What a run shows while it goes on: a live board on a terminal, plain lines elsewhere. Both to stderr."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, Protocol

from wasp_cli.console import duration, err, plain
from wasp_cli.errors import ArtifactError
from wasp_cli.plan.node import Node
from wasp_cli.run.order import Outcome
from wasp_cli.store.artifact import read_record

if TYPE_CHECKING:
    from rich.console import Group

POLL_SECONDS = 0.5
NAMES: Mapping[str, str] = MappingProxyType({})
"""What people call a node, by its key, where that is not its label: nowhere."""


class Board(Protocol):
    """Hears of a run's events."""

    def __enter__(self) -> Board: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...

    def ended(self, node: Node, outcome: Outcome) -> None:
        """A node ended."""
        ...

    def blocked(self, node: Node, by: Node) -> None:
        """A node cannot run, since one that it needs failed."""
        ...

    def note(self, text: str) -> None:
        """Something worth a line."""
        ...


class Quiet:
    """Shows nothing."""

    def __enter__(self) -> Quiet:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        pass

    def ended(self, node: Node, outcome: Outcome) -> None:
        pass

    def blocked(self, node: Node, by: Node) -> None:
        pass

    def note(self, text: str) -> None:
        pass


@dataclass(frozen=True)
class Running:
    """What a running node last said."""

    key: str
    label: str
    share: float
    text: str


def running_nodes(folder: Path, names: Mapping[str, str] = NAMES) -> list[Running]:
    """The nodes that run now, from the small files that their workers keep."""
    found = []
    for path in sorted(folder.glob("*.json")):
        try:
            record = read_record(path)
        except ArtifactError:  # replaced while it was read
            continue
        if record is not None:
            label = names.get(path.stem, str(record.get("label")))
            found.append(Running(path.stem, label, float(record.get("share", 0.0)), str(record.get("text", ""))))
    return found


class Lines:
    """One line for each event, for logs and pipes. Starts come from the running files, so short nodes show their end only."""

    def __init__(self, total: int, folder: Path, names: Mapping[str, str] = NAMES) -> None:
        self._total, self._folder, self._names = total, folder, names
        self._count = 0
        self._shown: set[str] = set()
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._watcher = threading.Thread(target=self._watch, daemon=True, name="progress")

    def __enter__(self) -> Lines:
        self._watcher.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stop.set()
        self._watcher.join()

    def _watch(self) -> None:
        while not self._stop.wait(POLL_SECONDS):
            for node in running_nodes(self._folder, self._names):
                with self._lock:
                    if node.key not in self._shown:
                        self._shown.add(node.key)
                        plain(f"        start   {node.label}" + (f"  ({node.text})" if node.text else ""))

    def ended(self, node: Node, outcome: Outcome) -> None:
        with self._lock:
            self._shown.add(node.key)
            self._count += 1
            plain(_ended_line(self._count, self._total, self._name(node), outcome))

    def blocked(self, node: Node, by: Node) -> None:
        with self._lock:
            self._count += 1
            plain(f"{_counter(self._count, self._total)} blocked {self._name(node)}  (needs {self._name(by)})")

    def _name(self, node: Node) -> str:
        return self._names.get(node.key, node.label)

    def note(self, text: str) -> None:
        with self._lock:
            plain(f"        note    {text}")


class Live:
    """A board that redraws itself: a bar, the running nodes with their share, and finished nodes scrolling by above."""

    def __init__(self, total: int, folder: Path, names: Mapping[str, str] = NAMES) -> None:
        from rich.live import Live as RichLive

        self._total, self._folder, self._names = total, folder, names
        self._count, self._bad = 0, 0
        self._started = time.monotonic()
        self._since: dict[str, float] = {}
        self._live = RichLive(console=err(), get_renderable=self._draw, refresh_per_second=2, transient=True, redirect_stdout=False)

    def __enter__(self) -> Live:
        self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._live.stop()

    def ended(self, node: Node, outcome: Outcome) -> None:
        self._count += 1
        self._bad += outcome.state == "failed"
        plain(_ended_line(self._count, self._total, self._name(node), outcome))

    def blocked(self, node: Node, by: Node) -> None:
        self._count += 1
        self._bad += 1
        plain(f"{_counter(self._count, self._total)} blocked {self._name(node)}  (needs {self._name(by)})")

    def note(self, text: str) -> None:
        plain(f"        note    {text}")

    def _name(self, node: Node) -> str:
        return self._names.get(node.key, node.label)

    def _draw(self) -> Group:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        now = time.monotonic()
        running = running_nodes(self._folder, self._names)
        head = Table.grid(padding=(0, 1))
        status = f"{self._count}/{self._total} done" + (f", {self._bad} failed or blocked" if self._bad else "")
        head.add_row(
            ProgressBar(total=max(self._total, 1), completed=self._count + sum(node.share for node in running), width=40),
            Text(f"{status}, {len(running)} running, {duration(now - self._started)}"),
        )
        rows = Table.grid(padding=(0, 2))
        for node in running:
            since = self._since.setdefault(node.key, now)
            rows.add_row(Text("  " + node.label), Text(f"{node.share:4.0%}"), Text(duration(now - since)), Text(node.text, style="dim"))
        return Group(head, rows)


def board(total: int, folder: Path, names: Mapping[str, str] = NAMES) -> Board:
    """The board that fits where stderr goes."""
    return Live(total, folder, names) if err().is_terminal and not err().is_dumb_terminal else Lines(total, folder, names)


def _counter(count: int, total: int) -> str:
    width = len(str(total))
    return f"[{count:>{width}}/{total}]"


def _ended_line(count: int, total: int, name: str, outcome: Outcome) -> str:
    what = {"done": "done   ", "shared": "shared ", "failed": "FAILED "}[outcome.state]
    detail = outcome.message if outcome.state == "failed" else numbers(outcome.summary)
    return f"{_counter(count, total)} {what} {name}  {duration(outcome.seconds)}" + (f"  {detail}" if detail else "")


def numbers(summary: Mapping[str, Any], limit: int = 6) -> str:
    """The first numbers of a summary on one line."""
    shown = [f"{name} {_number(value)}" for name, value in summary.items() if isinstance(value, int | float)]
    return ", ".join(shown[:limit])


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.4g}"
