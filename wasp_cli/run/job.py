"""What travels to a worker and what comes back (names and plain values, never tensors), and what a
running node says of itself.

And how a run and its nodes are ended early: Ctrl-C and SIGTERM for the run; a time limit, and being
taken back, for each node.
"""

from __future__ import annotations

import os
import platform
import resource
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from wasp_cli.console import duration
from wasp_cli.errors import ArtifactError, TimeLimitExceeded
from wasp_cli.run.signals import SIGNALS, handle
from wasp_cli.store.records import dumps, read_record, replace_file
from wasp_cli.tasks.foreign.limit import LimitReached, left_after, process_ended_after


@dataclass(frozen=True)
class NodeJob:
    root: str  # the results folder
    run_id: str
    kind: str
    key: str
    label: str
    task: str
    seed: int
    stage: str  # import string of the stage's class
    axes: Mapping[str, Any]
    config: Mapping[str, Any]
    settings: Mapping[str, Any]
    # kind and key of the upstream artifacts, by the name under which the stage reads them
    inputs: Mapping[str, tuple[str, str]]
    sources: Mapping[str, str]  # hash by module of the code that decides the result
    # key of the same artifact with fewer episodes, whose rows may be taken over
    earlier: str | None = None
    attempt: int = 1
    threads: int = 1
    limit: float | None = None  # seconds that it may take; None for no limit
    provenance: Mapping[str, Any] = field(default_factory=dict)
    folders: tuple[str, ...] = ()  # where modules that the spec names may lie


State = Literal["done", "shared", "failed", "busy", "skipped", "unseen"]


@dataclass(frozen=True)
class NodeResult:
    """How a node ended."""

    key: str
    state: State
    """`shared`: another run computed it; `busy`: another one computes it now; `skipped`: the
    run is to end; `unseen`: no results folder.
    """
    seconds: float
    summary: Mapping[str, Any] = field(default_factory=dict)
    message: str = ""
    hint: str | None = None
    log: str = ""
    by_chance: bool = False
    """Whether a failure may come from the moment (a full disk, memory, a bug that needs luck),
    so that another attempt may succeed.
    """
    unclosed: tuple[str, ...] = ()
    """What went wrong in closing the environments of the node, which is no failure of its own."""
    short: bool = False
    """Whether a failure is that of a strict run: the node is stored, and falls short of its bar."""


SECONDS = 1.0


class Heartbeat:
    """Keeps the file of a running node until the node ends, however it does. After a kill the
    file stays, and tells who was running.
    """

    def __init__(self, path: Path, job: NodeJob) -> None:
        self._path = path
        self.deaths = 0
        """Processes that died in this run while they computed the node. A scheduler of somebody
        else's gives it to the next one.
        """
        try:
            # an earlier attempt did not live to remove it
            if (left := read_record(path)) is not None:
                self.deaths = 1 + int(left.get("deaths", 0))
        except ArtifactError:
            self.deaths = 1
        # What does not change while it runs.
        self.fixed: dict[str, object] = {
            "label": job.label,
            "kind": job.kind,
            **this_process(),
            "started": _now(),
            "deaths": self.deaths,
        }
        self._share, self._text = 0.0, ""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True, name="heartbeat")

    def tell(self, share: float, text: str) -> None:
        """Note how far it is, from 0 to 1, and what it does; written with the next beat."""
        self._share, self._text = min(max(float(share), 0.0), 1.0), text

    def write(self) -> None:
        """Write it now. A full disk, or a folder that was moved, must not end the node here:
        its own writing will.
        """
        record = {
            **self.fixed,
            "share": self._share,
            "text": self._text,
            "at": _now(),
            "memory_mb": memory_mb(),
        }
        with suppress(OSError):
            replace_file(self._path, dumps(record))

    def __enter__(self) -> Heartbeat:
        self.write()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()
        with suppress(OSError):
            self._path.unlink(missing_ok=True)

    def _beat(self) -> None:
        while not self._ended.wait(SECONDS):
            self.write()


def forget(path: Path) -> None:
    for left in (path, *path.parent.glob(f".{path.name}-*")):
        left.unlink(missing_ok=True)


def memory_mb() -> float:
    """Return the memory of this process that is in use, in MB; where the system does not tell,
    the most that it ever was.
    """
    with (
        suppress(OSError, ValueError, IndexError),
        open("/proc/self/statm", encoding="ascii") as file,
    ):
        return round(int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)
    return round(
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        / (1e6 if sys.platform == "darwin" else 1e3),
        1,
    )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def this_process() -> dict[str, object]:
    """Name this process, so that others can see whether it lives."""
    return {"pid": os.getpid(), "host": platform.node(), "boot": boot_id()}


def boot_id() -> str | None:
    """Name the time since this machine started, so that a process id can be told from an older
    one; None where unknown.
    """
    with suppress(OSError, ValueError):
        # Linux only
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip() or None
    return None


class Stop:
    """Whether a run was asked to stop. Workers learn it from a file, on other machines too."""

    def __init__(self, path: Path, told: Callable[[], None]) -> None:
        self._path, self._told = path, told
        self.asked = False

    def ask(self) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        with suppress(OSError):
            self._path.touch()
        self._told()


@contextmanager
def listening(stop: Stop) -> Iterator[None]:
    """Turn signals into requests to stop. One that this process was started to ignore (`nohup`)
    stays ignored.
    """

    def ask(number: int, frame: object) -> None:
        stop.ask()

    before = {number: signal.getsignal(number) for number in SIGNALS}
    taken = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    try:
        for number in taken:
            handle(number, ask)
        yield
    finally:
        for number in taken:
            signal.signal(number, before[number])


GRACE = 10.0  # seconds that a node has to react; one with a shorter limit gets as long again
HINT = "allow more time with --timeout; the log shows where it was"


@contextmanager
def interruptible(limit: float | None, marker: Path, own_process: bool) -> Iterator[None]:
    """Raise TimeLimitExceeded in the block after `limit` seconds (see `left_after`).

    Code that never comes back to Python is ended with its process, where that is ours; `marker`
    then has text, so that whoever finds it gone knows why.
    """
    if limit is None:
        yield
        return
    try:
        with _ended_over(limit, marker) if own_process else nullcontext(), left_after(limit):
            yield
    except LimitReached:
        raise TimeLimitExceeded(
            f"it took longer than the limit of {duration(limit)}", HINT
        ) from None


@contextmanager
def _ended_over(limit: float, marker: Path) -> Iterator[None]:
    with marker.open("w", encoding="utf-8") as file:
        try:
            with process_ended_after(limit + min(GRACE, limit), file):
                yield
        finally:
            marker.unlink(missing_ok=True)


def was_ended(marker: Path) -> bool:
    with suppress(OSError):
        return marker.stat().st_size > 0
    return False
