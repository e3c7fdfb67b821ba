"""What a running node says of itself, written about once a second: how far it is, that it lives, and how much memory it holds."""

from __future__ import annotations

import os
import platform
import resource
import sys
import threading
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

from wasp_cli.errors import ArtifactError
from wasp_cli.run.job import NodeJob
from wasp_cli.store.artifact import dumps, read_record, replace_file

SECONDS = 1.0


class Heartbeat:
    """Keeps the file of a running node until the node ends, however it does. After a kill the file stays, and tells who was running."""

    def __init__(self, path: Path, job: NodeJob) -> None:
        self._path = path
        self.deaths = _deaths(path)
        """Processes that died in this run while they computed the node. A scheduler of somebody else's gives it to the next one."""
        self.fixed: dict[str, object] = {
            "label": job.label,
            "kind": job.kind,
            **this_process(),
            "started": _now(),
            "deaths": self.deaths,
        }
        """What does not change while it runs."""
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


def _deaths(path: Path) -> int:
    """What is left of an earlier attempt, which did not live to remove it, tells of one death and of those before."""
    try:
        record = read_record(path)
    except ArtifactError:
        return 1
    known = 0 if record is None else record.get("deaths", 0)
    return 0 if record is None else 1 + (known if isinstance(known, int) else 0)


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
