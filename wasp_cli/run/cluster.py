"""Workers on other machines: of a dask scheduler, of a ray cluster. Only jobs travel, which are keys, paths and plain values.

Each node is a task of its own, as in joblib's backends for both: `joblib.Parallel` takes a list, and through ray it gives results when
the last one is there.

The results folder has to be seen by every machine under the same path, and every worker has to run the same source: a worker that does not
refuses to publish. The machines' own schedulers decide where a node runs.
"""

from __future__ import annotations

import re
import socket
import threading
import time
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from importlib.util import find_spec
from itertools import count
from typing import Any

from wasp_cli.errors import UsageError, WaspError
from wasp_cli.run.job import NodeJob, NodeResult, Pool, WorkersDied
from wasp_cli.run.worker import execute

CONNECT_SECONDS = 20
CLOSE_SECONDS = 5
PACKAGES = {"dask": "distributed", "ray": "ray"}
EXAMPLES = {"dask": "--scheduler tcp://HOST:8786", "ray": "--scheduler HOST:6379"}
STARTS = {"dask": "start one: dask scheduler", "ray": "start one: ray start --head"}
POLL_SECONDS = 0.1
COUNT_SECONDS = 2.0
"""Between two looks at the workers of a dask scheduler."""


def require_cluster(backend: str, scheduler: str | None) -> None:
    """See that a cluster can be used, before anything is planned for it."""
    package = PACKAGES[backend]
    if find_spec(package) is None:
        raise UsageError(f"the backend {backend} needs the package '{package}'", f"pip install 'wasp-cli[{backend}]'")
    if scheduler is not None:
        _require_answer(backend, scheduler)
    elif backend == "dask":  # ray starts one of its own on this machine
        raise UsageError("the backend dask needs the address of its scheduler", EXAMPLES["dask"])


def cluster_pool(backend: str, scheduler: str | None) -> Pool:
    """Return the workers of a dask scheduler or of a ray cluster, of which `require_cluster` has said that it is there."""
    pool: Pool = DaskPool(scheduler) if backend == "dask" else RayPool(scheduler)
    return pool


def execute_here(job: NodeJob) -> NodeResult:
    """Compute a node in a process that belongs to somebody else."""
    return execute(job, own_process=False)


class DaskPool:
    """The workers of a dask scheduler, one task for each node."""

    name = "dask"

    def __init__(self, scheduler: str | None) -> None:
        from distributed import Client

        self.gone: str | None = None
        self._starts = f"dask worker {scheduler} --nthreads 1 --nworkers N"

        try:
            self._client = Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise _no_answer(self.name, str(scheduler), error) from error
        threads = self._client.nthreads()
        if not threads:
            self._client.close()
            raise UsageError(f"the dask scheduler at '{scheduler}' has no workers", self._starts)
        if max(threads.values()) > 1:
            self._client.close()
            raise UsageError(
                "a dask worker has several threads; nodes set threads, logs and memory of their whole process", "start it with --nthreads 1"
            )
        self.jobs = sum(threads.values())
        self._pending: set[Future[NodeResult]] = set()
        self._number = count()
        self._closed = threading.Event()
        threading.Thread(target=self._watch, daemon=True, name="dask-watch").start()

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        from distributed import KilledWorker

        found: Future[NodeResult] = Future()
        self._pending.add(found)

        def told(ended: Any) -> None:
            if found.done():  # the scheduler was given up meanwhile
                return
            self._pending.discard(found)
            error = ended.exception() if ended.status == "error" else None
            if isinstance(error, KilledWorker):
                found.set_exception(WorkersDied(str(error)))
            elif error is not None or ended.status != "finished":
                found.set_exception(_lost(self.name, f"{type(error).__name__}: {error}" if error else ended.status))
            else:
                found.set_result(ended.result())

        self._client.submit(execute_here, job, key=f"{job.run_id}-{job.key}-{next(self._number)}", pure=False).add_done_callback(told)
        return found

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        return self.submit(job)

    def _watch(self) -> None:
        """Give up what is pending where the scheduler is gone: its futures would wait for ever. Look whether there are workers."""
        looked = time.monotonic()
        while not self._closed.wait(POLL_SECONDS):
            if self._client.status in ("running", "connecting"):
                if self._client.status == "running" and time.monotonic() - looked > COUNT_SECONDS:
                    with suppress(Exception):  # whatever it says of a scheduler that goes away just now: the next look tells
                        self.gone = None if self._client.nthreads() else self._starts
                    looked = time.monotonic()
                continue
            for found in list(self._pending):
                self._pending.discard(found)
                with suppress(InvalidStateError):
                    found.set_exception(_lost(self.name, self._client.status))

    def close(self, *, kill: bool = False) -> None:
        self._closed.set()
        with suppress(OSError, TimeoutError):
            self._client.close(timeout=CLOSE_SECONDS)


def _lost(backend: str, reason: str) -> WaspError:
    return WaspError(f"the {backend} scheduler is lost ({reason})", "start it again, then run again: finished nodes are kept")


def _require_answer(backend: str, address: str) -> None:
    """See that something listens at an address: the libraries' own attempts take minutes, and print what helps nobody."""
    found = re.fullmatch(r"(?:\w+://)?\[?([^/\]]+)\]?:(\d+)/?", address)
    if found is None:
        raise UsageError(f"'{address}' is not the address of a {backend} scheduler", EXAMPLES[backend])
    try:
        socket.create_connection((found[1], int(found[2])), timeout=CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise _no_answer(backend, address, error) from error


def _no_answer(backend: str, address: str, error: Exception) -> UsageError:
    reason = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())
    return UsageError(f"no {backend} scheduler answers at '{address}': {reason[:200].lower()}", STARTS[backend])


class RayPool:
    """The workers of a ray cluster, one task for each node."""

    name = "ray"
    gone: str | None = None

    def __init__(self, scheduler: str | None) -> None:
        import ray

        try:
            ray.init(address=scheduler, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise _no_answer(self.name, str(scheduler), error) from error
        self._ray = ray
        # The runner asks what a killed node did; ray would run it again by itself.
        self._execute = ray.remote(num_cpus=1, max_retries=0)(execute_here)
        self.jobs = max(int(ray.cluster_resources().get("CPU", 1)), 1)

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        found: Future[NodeResult] = Future()

        def told(ended: Future[NodeResult]) -> None:
            error = ended.exception()
            if error is None:
                found.set_result(ended.result())
            elif isinstance(error, self._ray.exceptions.RayTaskError):
                found.set_exception(error)
            else:  # ray has many ways to say that a worker or its machine is gone
                found.set_exception(WorkersDied(str(error)))

        self._execute.remote(job).future().add_done_callback(told)
        return found

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        return self.submit(job)

    def close(self, *, kill: bool = False) -> None:
        self._ray.shutdown()
