"""Workers on this machine: this process, or processes of loky."""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from typing import Any

from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.pools.base import Pool, WorkersDied
from wasp_cli.run.shared_memory import require_semaphores
from wasp_cli.run.signals import leave_to_parent, signals_wait
from wasp_cli.run.worker import execute, execute_here
from wasp_cli.tasks.foreign.started import lead_session

END_SECONDS = 5  # that a worker may take to end after its main thread


class InlinePool(Pool):
    """This process, which computes a node before `submit` returns."""

    name = "inline"
    local = True

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        """Compute the node, and return its result as a future that has ended."""
        done: Future[NodeResult] = Future()
        done.set_result(execute_here(job))
        return done

    def close(self, *, kill: bool = False) -> None:
        """Do nothing: there are no workers."""


class LokyPool(Pool):
    """joblib's loky workers: started on first use, so that torch is imported once in each."""

    name = "loky"
    local = True

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._crew: _Crew | None = None
        self._others: list[_Crew] = []  # of nodes alone, and those that were replaced
        # loky takes a loaded world model for a memory leak, and replaces the worker with this
        # warning; nothing is lost.
        warnings.filterwarnings(
            "ignore", message="A worker stopped while some jobs", category=UserWarning
        )

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node in a worker process. Broken or worn processes are replaced
        first.
        """
        self._replace()
        if self._crew is None:
            self._crew = _Crew(self.jobs)
        try:
            return self._crew.begin(job)
        except BrokenExecutor as error:
            self._crew = None
            lost: Future[NodeResult] = Future()
            lost.set_exception(WorkersDied(str(error)))
            return lost

    def _replace(self) -> None:
        """Use new workers for the next nodes if these are broken or worn. Nodes that they still
        compute go on.
        """
        if self._crew is not None and (self._crew.worn or self._crew.broken):
            self._others.append(self._crew)
            self._crew = None
        for crew in self._others:
            if crew.is_idle():
                crew.end(wait=False, kill=True)
        self._others = [crew for crew in self._others if not crew.is_idle()]

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node in a process of its own, which ends with the node."""
        crew = _Crew(1)
        self._others.append(crew)
        result = crew.begin(job)
        result.add_done_callback(lambda _: crew.end(wait=False, kill=True))
        return result

    def close(self, *, kill: bool = False) -> None:
        """End all processes: when their nodes have ended, or with `kill` at once."""
        for crew in (self._crew, *self._others):
            if crew is not None:
                crew.end(wait=not kill, kill=kill)
        self._crew = None
        self._others = []


class _Crew:
    """Workers of one executor, and what they compute."""

    def __init__(self, count: int) -> None:
        self._workers = _new_workers(count)
        self._running: list[Future[NodeResult]] = []
        self.broken = False
        """Whether a worker was killed, which ends all of them."""
        self.worn = False
        """Whether an environment may still run in a worker, so that it gets no other node."""

    def begin(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node. Its future ends with WorkersDied if a worker was killed."""

        def translate(error: BaseException) -> BaseException:
            if not isinstance(error, BrokenExecutor):
                return error
            self.broken = True
            return WorkersDied(str(error))

        def note_wear(ended: Future[NodeResult]) -> None:
            if ended.exception() is None and ended.result().unclosed:
                self.worn = True

        with signals_wait():
            running: Future[NodeResult] = self._workers.submit(execute, job)
        running.add_done_callback(note_wear)
        self._running = [other for other in self._running if not other.done()]
        self._running.append(running)
        return _passed_on(running, translate)

    def is_idle(self) -> bool:
        """Return whether all nodes that were begun here have ended."""
        return all(running.done() for running in self._running)

    def end(self, *, wait: bool, kill: bool) -> None:
        """End the workers: with `wait` after what they compute, with `kill` at once."""
        self._workers.shutdown(wait=wait, kill_workers=kill)


def _passed_on(
    running: Future[NodeResult], translate: Callable[[BaseException], BaseException]
) -> Future[NodeResult]:
    """A future that ends as `running` does, with its error translated."""
    result: Future[NodeResult] = Future()

    def pass_on(ended: Future[NodeResult]) -> None:
        error = ended.exception()
        if error is None:
            result.set_result(ended.result())
        else:
            result.set_exception(translate(error))

    running.add_done_callback(pass_on)
    return result


def _new_workers(count: int) -> Any:
    require_semaphores(count)
    from joblib.externals.loky import ProcessPoolExecutor

    return ProcessPoolExecutor(max_workers=count, initializer=start_worker, initargs=(os.getpid(),))


def start_worker(parent: int) -> None:
    """Prepare a worker process: the parent decides when it stops, and it ends with the parent.

    It leaves the terminal. Otherwise Ctrl-C there would reach the processes of environments and end
    them, while their nodes are to be finished.
    """
    leave_to_parent()
    lead_session()
    threading.Thread(target=_end_with, args=(parent,), daemon=True, name="parent-watch").start()


def _end_with(parent: int) -> None:
    """End this process with its parent, and soon after its main thread: otherwise a thread that an
    environment has left behind would keep it alive for ever.
    """
    while os.getppid() == parent:
        if not threading.main_thread().is_alive():
            time.sleep(END_SECONDS)
            os._exit(0)
        time.sleep(1.0)
    os.killpg(0, signal.SIGKILL)  # with all processes that it has started
