"""Workers of a dask scheduler, which may be on other machines."""

from __future__ import annotations

import re
import socket
import threading
import time
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from itertools import count
from typing import Any

from wasp_cli.errors import UsageError, WaspError, described
from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.pools.base import POLL_SECONDS, Pool, WorkersDied
from wasp_cli.run.worker import execute_here

EXAMPLE = "--scheduler tcp://HOST:8786"
ADDRESS = re.compile(r"(?:\w+://)?\[?(?P<host>[^/\]]+)\]?:(?P<port>\d+)/?")
CONNECT_SECONDS = 20  # that a scheduler may take to answer
CLOSE_SECONDS = 5
COUNT_SECONDS = 2.0  # between two looks at the workers


class DaskPool(Pool):
    """The workers of a dask scheduler, each with one thread."""

    name = "dask"

    def __init__(self, scheduler: str | None) -> None:
        from distributed import Client

        self._start_hint = f"dask worker {scheduler} --nthreads 1 --nworkers N"
        try:
            self._client = Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise _no_answer(str(scheduler), error) from error
        threads = self._client.nthreads().values()
        problem = None
        if not threads:
            problem = f"the dask scheduler at '{scheduler}' has no workers"
        elif max(threads) > 1:
            problem = (
                "a dask worker has several threads; nodes set threads, logs and memory of their "
                "whole process"
            )
        if problem is not None:
            self._client.close()
            raise UsageError(problem, self._start_hint)
        self.jobs = len(threads)
        self._pending: set[Future[NodeResult]] = set()
        self._number = count()
        self._closed = threading.Event()
        threading.Thread(target=self._watch, daemon=True, name="dask-watch").start()

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        """Submit a node to the scheduler. Its future also ends with an error if the scheduler is
        lost.
        """
        from distributed import KilledWorker

        result: Future[NodeResult] = Future()
        self._pending.add(result)

        def pass_on(ended: Any) -> None:
            with suppress(InvalidStateError):  # `_watch` has given it up
                try:
                    error = ended.exception() if ended.status == "error" else None
                    if error is None and ended.status == "finished":
                        result.set_result(ended.result())
                    elif isinstance(error, KilledWorker):
                        result.set_exception(WorkersDied(str(error)))
                    else:
                        result.set_exception(_lost(described(error) if error else ended.status))
                except Exception as error:
                    # The scheduler has died, so the worker's result cannot be fetched.
                    result.set_exception(_lost(described(error)))
            self._pending.discard(result)

        # A node may be submitted again after a death: under the same name dask would return the
        # first result.
        name = f"{job.run_id}-{job.key}-{next(self._number)}"
        running = self._client.submit(execute_here, job, key=name, pure=False)
        running.add_done_callback(pass_on)
        return result

    def _watch(self) -> None:
        """Give up what is pending if the scheduler is lost, since its futures would never end; and
        note whether there are workers.
        """
        counted_at = time.monotonic()
        while not self._closed.wait(POLL_SECONDS):
            status = self._client.status
            if status not in ("running", "connecting"):
                for result in list(self._pending):
                    self._pending.discard(result)
                    with suppress(InvalidStateError):
                        result.set_exception(_lost(status))
            elif status == "running" and time.monotonic() - counted_at > COUNT_SECONDS:
                # A scheduler that is just ending may raise anything; its status says so next time.
                with suppress(Exception):
                    self.gone = None if self._client.nthreads() else self._start_hint
                counted_at = time.monotonic()

    def close(self, *, kill: bool = False) -> None:
        """Disconnect from the scheduler; its workers stay."""
        self._closed.set()
        with suppress(OSError, TimeoutError):
            self._client.close(timeout=CLOSE_SECONDS)


def require_scheduler(address: str | None) -> None:
    """Check that something listens at the address of a scheduler. The library's own attempts take
    minutes, with messages that do not help.

    Raises:
        UsageError: there is no address, it is malformed, or nothing answers there.
    """
    if address is None:
        raise UsageError("the backend dask needs the address of its scheduler", EXAMPLE)
    match = ADDRESS.fullmatch(address)
    if match is None:
        raise UsageError(f"'{address}' is not the address of a dask scheduler", EXAMPLE)
    place = (match["host"], int(match["port"]))
    try:
        socket.create_connection(place, timeout=CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise _no_answer(address, error) from error


def _no_answer(address: str, error: Exception) -> UsageError:
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    one_line = " ".join(reason.split())[:200].lower()
    return UsageError(
        f"no dask scheduler answers at '{address}': {one_line}", "start one: dask scheduler"
    )


def _lost(reason: str) -> WaspError:
    return WaspError(
        f"the dask scheduler is lost ({reason})",
        "start it again, then run again: finished nodes are kept",
    )
