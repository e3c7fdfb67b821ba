"""What travels to a worker and what comes back (names and plain values, never tensors), and what a running node says of itself."""

from __future__ import annotations

import os
import platform
import resource
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

from wasp_cli.errors import ArtifactError
from wasp_cli.store.artifact import dumps, read_record, replace_file


@dataclass(frozen=True)
class NodeJob:
    """One node for one worker."""

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
    inputs: Mapping[str, tuple[str, str]]  # kind and key of the upstream artifacts, by the name under which the stage reads them
    sources: Mapping[str, str]  # hash by module of the code that decides the result
    earlier: str | None = None  # key of the same artifact with fewer episodes, whose rows may be taken over
    attempt: int = 1
    threads: int = 1
    limit: float | None = None  # seconds that it may take; None for no limit
    wait: bool = False  # whether to wait while another run computes it; otherwise it comes back as `busy`
    provenance: Mapping[str, Any] = field(default_factory=dict)


State = Literal["done", "shared", "failed", "cancelled", "busy", "skipped", "unseen"]


@dataclass(frozen=True)
class NodeResult:
    """How a node ended.

    `shared`: another run computed it meanwhile; `busy`: another run computes it now; `cancelled`: it was taken back; `skipped`: the run is
    to end; `unseen`: its worker does not see the results folder.
    """

    key: str
    state: State
    seconds: float
    summary: Mapping[str, Any] = field(default_factory=dict)
    message: str = ""
    hint: str | None = None
    log: str = ""
    by_chance: bool = False
    """Whether a failure may come from the moment (a full disk, memory, a bug that needs luck), so that another attempt may succeed."""


SECONDS = 1.0


class Heartbeat:
    """Keeps the file of a running node until the node ends, however it does. After a kill the file stays, and tells who was running."""

    def __init__(self, path: Path, job: NodeJob) -> None:
        self._path = path
        self.deaths = 0
        """Processes that died in this run while they computed the node. A scheduler of somebody else's gives it to the next one."""
        try:
            if (left := read_record(path)) is not None:  # an earlier attempt did not live to remove it
                self.deaths = 1 + int(left.get("deaths", 0))
        except ArtifactError:
            self.deaths = 1
        self.fixed: dict[str, object] = {  # what does not change while it runs
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
        """Write it now. A full disk, or a folder that was moved, must not end the node here: its own writing will."""
        record = {**self.fixed, "share": self._share, "text": self._text, "at": _now(), "memory_mb": memory_mb()}
        with suppress(OSError):
            replace_file(self._path, dumps(record))

    def __enter__(self) -> Heartbeat:
        self.write()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join()
        with suppress(OSError):
            self._path.unlink(missing_ok=True)

    def _beat(self) -> None:
        while not self._ended.wait(SECONDS):
            self.write()


def forget(path: Path) -> None:
    """Remove what a killed node left to say that it runs: its file, and the half-written next one where it died while it wrote."""
    for left in (path, *path.parent.glob(f".{path.name}-*")):
        left.unlink(missing_ok=True)


def memory_mb() -> float:
    """Return the memory of this process that is in use, in MB; where the system does not tell, the most that it ever was."""
    with suppress(OSError, ValueError, IndexError), open("/proc/self/statm", encoding="ascii") as file:
        return round(int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(largest / (1e6 if sys.platform == "darwin" else 1e3), 1)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def this_process() -> dict[str, object]:
    """Name this process, so that others can see whether it lives."""
    return {"pid": os.getpid(), "host": platform.node(), "boot": boot_id()}


def boot_id() -> str | None:
    """Name the time since this machine started, so that a process id can be told from an older one; None where unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip() or None  # Linux only
    except (OSError, ValueError):
        return None
