"""A real dask scheduler and two worker processes on this machine."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from tests.run.harness import ROOT, wait_until


@dataclass
class Cluster:
    """Where it is, and who works for it."""

    address: str
    processes: list[subprocess.Popen[str]]
    add: Callable[[str], None]
    """Start one more worker, of this name."""


@contextmanager
def dask_cluster(folder: Path, workers: int = 2, cwd: Path = ROOT) -> Iterator[Cluster]:
    """Start it, and end it with all its processes. The workers' working directory is `cwd`."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    started: list[subprocess.Popen[str]] = []

    def start(name: str, *arguments: str) -> Path:
        log = folder / f"{name}.log"
        with log.open("w", encoding="utf-8") as file:
            command = [sys.executable, "-m", "dask", *arguments]
            started.append(subprocess.Popen(command, cwd=cwd, env=environment, stdout=file, stderr=file, text=True, start_new_session=True))
        return log

    folder.mkdir(parents=True, exist_ok=True)
    try:
        log = start("scheduler", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        wait_until(lambda: "Scheduler at:" in log.read_text(encoding="utf-8"))
        line = next(line for line in log.read_text(encoding="utf-8").splitlines() if "Scheduler at:" in line)
        address = line.partition("Scheduler at:")[2].strip()
        local = ("--local-directory", str(folder / "scratch"), "--no-dashboard", "--host", "127.0.0.1")

        def add(*names: str) -> None:
            logs = [start(name, "worker", address, "--nthreads", "1", *local) for name in names]
            wait_until(lambda: all("Registered to:" in log.read_text(encoding="utf-8") for log in logs))

        add(*(f"worker{number}" for number in range(workers)))
        yield Cluster(address, started, add)
    finally:
        for process in started:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait(timeout=300)
