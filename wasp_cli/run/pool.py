"""The workers of a run: processes of loky, or this process. Those of other machines are in `run.cluster`."""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Iterable, Iterator
from concurrent.futures import BrokenExecutor
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

    def run(self, node_jobs: Iterable[NodeJob]) -> Iterator[NodeResult]:
        for job in node_jobs:
            yield execute(job, own_process=False)

    def alone(self, job: NodeJob) -> NodeResult:
        return execute(job, own_process=False)

    def close(self, *, kill: bool = False) -> None:
        pass


class LokyPool:
    """joblib's loky workers: started on first use, reused from wave to wave, so that torch is imported once in each."""

    name = "loky"

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._single: Any = None

    def run(self, node_jobs: Iterable[NodeJob]) -> Iterator[NodeResult]:
        try:
            # joblib takes n_jobs=1 as "in this process", where a killed node would take the run along.
            yield from self._one_by_one(node_jobs) if self.jobs == 1 else self._side_by_side(node_jobs)
        except BrokenExecutor as error:
            self._single = None
            raise WorkersDied(str(error)) from error

    def _side_by_side(self, node_jobs: Iterable[NodeJob]) -> Iterator[NodeResult]:
        from joblib import Parallel, delayed

        workers = Parallel(
            n_jobs=self.jobs,
            backend="loky",
            return_as="generator_unordered",
            batch_size=1,  # "auto" would bundle short nodes, and report them late
            initializer=start_worker,
            initargs=(os.getpid(),),
        )
        with warnings.catch_warnings():
            # loky takes a loaded world model for a memory leak, replaces the worker and says so; nothing is lost.
            warnings.filterwarnings("ignore", message="A worker stopped while some jobs", category=UserWarning)
            with _signals_wait():
                results = workers(delayed(execute)(job) for job in node_jobs)
            yield from results

    def _one_by_one(self, node_jobs: Iterable[NodeJob]) -> Iterator[NodeResult]:
        if self._single is None:
            self._single = _new_worker()
        for job in node_jobs:
            with _signals_wait():
                running = self._single.submit(execute, job)
            result: NodeResult = running.result()
            yield result

    def alone(self, job: NodeJob) -> NodeResult:
        worker = _new_worker()
        try:
            with _signals_wait():
                running = worker.submit(execute, job)
            result: NodeResult = running.result()
        except BrokenExecutor as error:
            raise WorkersDied(str(error)) from error
        finally:
            worker.shutdown(wait=False, kill_workers=True)
        return result

    def close(self, *, kill: bool = False) -> None:
        from joblib.externals.loky import reusable_executor

        shared = reusable_executor._executor  # get_reusable_executor() would start one
        for executor in (self._single, shared):
            if executor is not None:
                executor.shutdown(wait=not kill, kill_workers=kill)
        self._single = None


BACKENDS = ("loky", "dask", "ray")


def require_backend(backend: str, scheduler: str | None) -> None:
    """See that a backend can be used, before anything is planned for it.

    Raises:
        UnknownName: there is none of this name.
        UsageError: its package is not installed, or its scheduler does not answer.
    """
    if backend not in BACKENDS:
        raise UnknownName("backend", backend, BACKENDS)
    if backend != "loky":
        from wasp_cli.run.cluster import require_cluster

        require_cluster(backend, scheduler)
    elif scheduler is not None:
        raise UsageError("--scheduler is for the backends dask and ray", "wasp run SPEC --backend dask --scheduler tcp://HOST:PORT")


def pool_of(backend: str, jobs: int, scheduler: str | None = None) -> Pool:
    """Return the workers of a backend.

    Args:
        backend: one of `BACKENDS`.
        jobs: worker processes on this machine at most; 0 computes in this process. Others bring their own number.
        scheduler: address of the others' scheduler.
    """
    if backend != "loky":
        from wasp_cli.run.cluster import cluster_pool

        return cluster_pool(backend, scheduler)
    return LokyPool(jobs) if jobs else InlinePool()


def _new_worker() -> Any:
    from joblib.externals.loky import ProcessPoolExecutor

    return ProcessPoolExecutor(max_workers=1, initializer=start_worker, initargs=(os.getpid(),))


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
