"""Workers on other machines, through joblib's own backends: dask and ray. Only node_jobs travel, which are keys, paths and plain values.

The results folder has to be seen by every machine under the same path, and every worker has to run the same source: a worker that does not
refuses to publish. The machines' own schedulers decide where a node runs.
"""

from __future__ import annotations

import queue
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from wasp_cli.errors import ArtifactError, UsageError, WaspError
from wasp_cli.run.job import NodeJob, NodeResult, Pool, WorkersDied
from wasp_cli.run.worker import execute
from wasp_cli.store.artifact import read_record, write_record
from wasp_cli.store.layout import Layout

CONNECT_SECONDS = 20
CLOSE_SECONDS = 5
PACKAGES = {"dask": "distributed", "ray": "ray"}
EXAMPLES = {"dask": "--scheduler tcp://HOST:8786", "ray": "--scheduler HOST:6379"}
STARTS = {"dask": "start one: dask scheduler", "ray": "start one: ray start --head"}
POLL_SECONDS = 0.1


def require_cluster(backend: str, scheduler: str | None) -> None:
    """See that a cluster can be used, before anything is planned for it.

    Raises:
        UsageError: its package is not installed, it has no address, or nothing answers there.
    """
    package = PACKAGES[backend]
    if find_spec(package) is None:
        raise UsageError(f"the backend {backend} needs the package '{package}'", f"pip install 'wasp-cli[{backend}]'")
    if scheduler is not None:
        _require_answer(backend, scheduler)
    elif backend == "dask":  # ray starts one of its own on this machine
        raise UsageError("the backend dask needs the address of its scheduler", EXAMPLES["dask"])


def cluster_pool(backend: str, scheduler: str | None) -> Pool:
    """The workers of a dask scheduler or of a ray cluster, of which `require_cluster` has said that it is there.

    Raises:
        UsageError: it does not answer after all, or its workers do not fit.
    """
    pool: Pool = DaskPool(scheduler) if backend == "dask" else RayPool(scheduler)
    return pool


def execute_here(job: NodeJob) -> NodeResult:
    """Compute a node in a process that belongs to somebody else."""
    return execute(job, own_process=False)


class DaskPool:
    """The workers of a dask scheduler, through joblib's dask backend."""

    name = "dask"

    def __init__(self, scheduler: str | None) -> None:
        from distributed import Client

        try:
            self._client = Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise _no_answer(self.name, str(scheduler), error) from error
        threads = self._client.nthreads()
        if not threads:
            self._client.close()
            raise UsageError(f"the dask scheduler at '{scheduler}' has no workers", "dask worker ADDRESS --nthreads 1 --nworkers N")
        if max(threads.values()) > 1:
            self._client.close()
            raise UsageError(
                "a dask worker has several threads; nodes set threads, logs and memory of their whole process", "start it with --nthreads 1"
            )
        self.jobs = sum(threads.values())

    def run(self, node_jobs: Iterable[NodeJob]) -> Iterator[NodeResult]:
        from distributed import KilledWorker

        # In a thread of its own: joblib waits for ever for a scheduler that is gone, and Ctrl-C has to come through.
        sent: queue.SimpleQueue[NodeResult | Exception | None] = queue.SimpleQueue()
        threading.Thread(target=self._send, args=(node_jobs, sent), daemon=True, name="dask-sender").start()
        while True:
            try:
                found = sent.get(timeout=POLL_SECONDS)
            except queue.Empty:
                if self._client.status not in ("running", "connecting"):
                    raise _lost(self.name, self._client.status) from None
                continue
            if found is None:
                return
            if isinstance(found, KilledWorker):
                raise WorkersDied(str(found)) from found
            if isinstance(found, Exception):
                raise _lost(self.name, f"{type(found).__name__}: {found}") from found
            yield found

    def _send(self, node_jobs: Iterable[NodeJob], sent: queue.SimpleQueue[NodeResult | Exception | None]) -> None:
        from joblib import Parallel, delayed, parallel_config

        try:
            with parallel_config(backend="dask", client=self._client, pure=False):
                parallel = Parallel(n_jobs=-1, return_as="generator_unordered", batch_size=1)
                for result in parallel(delayed(execute_here)(job) for job in node_jobs):
                    sent.put(result)
            sent.put(None)
        except Exception as error:  # whatever it is, it is told where results are waited for
            sent.put(error)

    def alone(self, job: NodeJob) -> NodeResult:
        return next(self.run([job]))

    def close(self, *, kill: bool = False) -> None:
        with suppress(OSError, TimeoutError):
            self._client.close(timeout=CLOSE_SECONDS)


def _lost(backend: str, reason: str) -> WaspError:
    return WaspError(f"the {backend} scheduler is lost ({reason})", "start it again, then run again: finished nodes are kept")


def _require_answer(backend: str, address: str) -> None:
    """See that something listens at an address: the libraries' own attempts take minutes, and print what helps nobody."""
    found = re.fullmatch(r"(?:\w+://)?\[?([^/\]]+)\]?:(\d+)/?", address)
    if found is None:
        raise UsageError(f"'{address}' is no address of a {backend} scheduler", EXAMPLES[backend])
    try:
        socket.create_connection((found[1], int(found[2])), timeout=CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise _no_answer(backend, address, error) from error


def _no_answer(backend: str, address: str, error: Exception) -> UsageError:
    reason = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())
    return UsageError(f"no {backend} scheduler answers at '{address}': {reason[:200].lower()}", STARTS[backend])


class RayPool:
    """The workers of a ray cluster, through joblib's ray backend.

    That backend gives results when the last one is there; so workers leave each result in a file, as soon as there is one.
    """

    name = "ray"

    def __init__(self, scheduler: str | None) -> None:
        import ray
        from ray.util.joblib import register_ray

        try:
            ray.init(address=scheduler, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise _no_answer(self.name, str(scheduler), error) from error
        register_ray()
        self._ray = ray
        self.jobs = max(int(ray.cluster_resources().get("CPU", 1)), 1)

    def run(self, node_jobs: Iterable[NodeJob]) -> Iterator[NodeResult]:
        node_jobs = list(node_jobs)
        if not node_jobs:
            return
        folder = _results(node_jobs[0])
        folder.mkdir(exist_ok=True)
        left = {job.key: job for job in node_jobs}
        errors: list[Exception] = []
        sender = threading.Thread(target=_reported(self._send, errors), args=(node_jobs,), daemon=True, name="ray-sender")
        sender.start()
        while left:
            last = not sender.is_alive()  # asked first: what it left before its end is still read
            for result in _taken(folder, left):
                del left[result.key]
                yield result
            if last and left:
                raise WorkersDied(str(errors[0]) if errors else "ray lost workers") from (errors[0] if errors else None)
            time.sleep(POLL_SECONDS)
        sender.join()

    def _send(self, node_jobs: list[NodeJob]) -> None:
        from joblib import Parallel, delayed, parallel_config

        with parallel_config(backend="ray"):
            Parallel(n_jobs=self.jobs, batch_size=1)(delayed(execute_and_tell)(job) for job in node_jobs)

    def alone(self, job: NodeJob) -> NodeResult:
        return next(self.run([job]))

    def close(self, *, kill: bool = False) -> None:
        self._ray.shutdown()


def execute_and_tell(job: NodeJob) -> None:
    """Compute a node, and leave its result where the run looks for it."""
    result = execute_here(job)
    write_record(_results(job) / f"{job.key}.json", asdict(result))


def _results(job: NodeJob) -> Path:
    return Layout(Path(job.root)).run(job.run_id) / "outcomes"


def _taken(folder: Path, left: dict[str, NodeJob]) -> Iterator[NodeResult]:
    for path in sorted(folder.glob("*.json")):
        if path.stem not in left:
            continue
        try:
            record = read_record(path)
        except ArtifactError:
            record = None
        if record is not None:
            path.unlink()
            yield NodeResult(**record)


def _reported(work: Callable[..., None], errors: list[Exception]) -> Callable[..., None]:
    def run(*arguments: Any) -> None:
        try:
            work(*arguments)
        except Exception as error:  # ray has many; whichever it is, what is left runs again or is named
            errors.append(error)

    return run
