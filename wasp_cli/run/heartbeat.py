"""The small file of a running node, which is written every second."""

from __future__ import annotations

import threading
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from wasp_cli.errors import ArtifactError
from wasp_cli.run.job import NodeJob
from wasp_cli.run.process import this_process
from wasp_cli.store.records import dumps, read_record, replace_file

SECONDS = 1.0  # between two beats


class Heartbeat:
    """Writes the file of a running node, and removes it when the node ends. If the process is
    killed, the file stays and says which node was running.
    """

    def __init__(self, path: Path, job: NodeJob) -> None:
        self._path = path
        self.deaths = 0
        """Processes that died in this run while they computed the node: a scheduler such as dask
        gives it to another one by itself.
        """
        try:
            # A file that is there already was left by an attempt that was killed.
            earlier = read_record(path)
            if earlier is not None:
                self.deaths = 1 + int(earlier.get("deaths", 0))
        except ArtifactError:
            self.deaths = 1
        self.fixed: dict[str, object] = {
            "label": job.label,
            "kind": job.kind,
            **this_process(),
            "started": _now(),
            "deaths": self.deaths,
        }
        """What does not change while it runs."""
        self._share = 0.0
        self._text = ""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True, name="heartbeat")

    def tell(self, share: float, text: str) -> None:
        """Note how far it is, from 0 to 1, and what it does; written with the next beat."""
        self._share = min(max(float(share), 0.0), 1.0)
        self._text = text

    def write(self) -> None:
        """Write the file now. If the disk is full or the folder was moved, the node does not fail
        here, but when it stores its result.
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
    """Remove the file of a node that does not run any more, and partial files of a killed write."""
    for file in (path, *path.parent.glob(f".{path.name}-*")):
        file.unlink(missing_ok=True)


def memory_mb() -> float:
    """Return the memory of this process that is in use, in MB."""
    import psutil  # here: only processes that compute need it

    size: int = psutil.Process().memory_info().rss
    return round(size / 1e6, 1)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
