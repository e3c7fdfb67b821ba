"""The workers of a run: processes of loky, or this process. Those of other machines are in `run.cluster`."""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Future
from contextlib import contextmanager
from typing import Any

from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.run.interrupt import SIGNALS
from wasp_cli.run.job import NodeJob, NodeResult, Pool, WorkersDied
from wasp_cli.run.worker import execute


class InlinePool:
    """This process, one node after the other: for tests and debuggers."""

    jobs = 1
    name = "inline"
    gone: str | None = None

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        done: Future[NodeResult] = Future()
        done.set_result(execute(job, own_process=False))
        return done

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        return self.submit(job)

    def close(self, *, kill: bool = False) -> None:
        pass


class LokyPool:
    """joblib's loky workers: started on first use, so that torch is imported once in each.

    Its executor, and not `joblib.Parallel`, which takes a list: what a node needs is only known to be there when another one ends.
    """

    name = "loky"
    gone: str | None = None

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._workers: Any = None
        self._single: list[Any] = []
        """Executors of nodes alone."""
        # loky takes a loaded world model for a memory leak, replaces the worker and says so; nothing is lost.
        warnings.filterwarnings("ignore", message="A worker stopped while some jobs", category=UserWarning)

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        if self._workers is None:
            self._workers = _new_workers(self.jobs)
        try:
            return self._begun(self._workers, job)
        except BrokenExecutor as error:
            self._workers = None
            return _died(error)

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        worker = _new_workers(1)
        self._single.append(worker)
        found = self._begun(worker, job)
        found.add_done_callback(lambda _: worker.shutdown(wait=False, kill_workers=True))
        return found

    def _begun(self, workers: Any, job: NodeJob) -> Future[NodeResult]:
        with _signals_wait():
            running: Future[NodeResult] = workers.submit(execute, job)
        result: Future[NodeResult] = Future()

        def told(ended: Future[NodeResult]) -> None:
            error = ended.exception()
            if isinstance(error, BrokenExecutor):
                if workers is self._workers:
                    self._workers = None  # the next node starts new ones
                result.set_exception(WorkersDied(str(error)))
            elif error is not None:
                result.set_exception(error)
            else:
                result.set_result(ended.result())

        running.add_done_callback(told)
        return result

    def close(self, *, kill: bool = False) -> None:
        for workers in (self._workers, *self._single):
            if workers is not None:
                workers.shutdown(wait=not kill, kill_workers=kill)
        self._workers, self._single = None, []


def _died(error: BaseException) -> Future[NodeResult]:
    lost: Future[NodeResult] = Future()
    lost.set_exception(WorkersDied(str(error)))
    return lost


BACKENDS = ("loky", "dask", "ray")


def require_backend(backend: str, scheduler: str | None) -> None:
    """See that a backend can be used, before anything is planned for it."""
    if backend not in BACKENDS:
        raise UnknownName("backend", backend, BACKENDS)
    if backend != "loky":
        from wasp_cli.run.cluster import require_cluster

        require_cluster(backend, scheduler)
    elif scheduler is not None:
        raise UsageError("--scheduler is for the backends dask and ray", "wasp run SPEC --backend dask --scheduler tcp://HOST:PORT")


def pool_of(backend: str, jobs: int, scheduler: str | None = None) -> Pool:
    """Return the workers of a backend."""
    if backend != "loky":
        from wasp_cli.run.cluster import cluster_pool

        return cluster_pool(backend, scheduler)
    return LokyPool(jobs) if jobs else InlinePool()


def _new_workers(count: int) -> Any:
    from joblib.externals.loky import ProcessPoolExecutor

    return ProcessPoolExecutor(max_workers=count, initializer=start_worker, initargs=(os.getpid(),))


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Hold back signals while processes start. They begin with this thread's mask; one that is not ready would end with a traceback."""
    from joblib.externals.loky.backend import resource_tracker

    resource_tracker.ensure_running()  # it lifts the mask when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def start_worker(parent: int) -> None:
    """Prepare a worker process: being stopped is the parent's business, and without a parent there is nobody to work for."""
    for number in SIGNALS:  # a terminal and a service manager send theirs to the whole group
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)  # children of this process begin with its mask
    threading.Thread(target=_end_with, args=(parent,), daemon=True, name="parent-watch").start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
