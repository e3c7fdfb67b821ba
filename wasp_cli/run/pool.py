"""The workers of a run: processes of loky, this process, those of a dask scheduler or a ray
cluster, or Slurm jobs.

Only jobs travel: keys, paths and plain values. Each node is a task of its own, since what it needs
is only there when another one ends. Every machine has to see the results folder under the same path
and to run the same source: a worker that does not refuses to publish.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, InvalidStateError
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

from wasp_cli.console import plain
from wasp_cli.errors import UsageError, WaspError, described
from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.shared_memory import refusal_of_semaphores, require_semaphores
from wasp_cli.run.signals import leave_to_parent, signals_wait
from wasp_cli.run.worker import execute, execute_here
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.foreign.started import lead_session

PACKAGES = {"dask": "distributed", "ray": "ray", "slurm": "submitit"}
LOCAL = "loky"
BACKENDS = (LOCAL, *PACKAGES)
EXAMPLES = {
    "dask": "--scheduler tcp://HOST:8786",
    "ray": "--scheduler HOST:6379",
    "slurm": "--scheduler partition=cpu,time=720,mem=8GB",
}
STARTS = {"dask": "start one: dask scheduler", "ray": "start one: ray start --head"}
CONNECT_SECONDS = 20
CLOSE_SECONDS = 5
POLL_SECONDS = 0.1
COUNT_SECONDS = 2.0  # between two looks at the workers of a dask scheduler


class WorkersDied(Exception):
    """A worker process was killed; the results that were not yet given are lost, artifacts are
    not.
    """


class Pool(ABC):
    jobs = 1  # nodes at once
    name = ""
    # whether nodes share this machine, and one process that is killed takes the others along
    local = False
    # how to start workers, where all have gone and what was given to them waits; None as long as
    # there are some
    gone: str | None = None

    @abstractmethod
    def submit(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node; nobody submits more than `jobs` at a time. It ends with
        WorkersDied where any worker was killed.
        """

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        return self.submit(job)

    @abstractmethod
    def close(self, *, kill: bool = False) -> None:
        """End the workers; with `kill`, at once."""


def require_backend(backend: str, scheduler: str | None) -> None:
    package = PACKAGES.get(backend)
    if package is None and scheduler is not None:
        raise UsageError(
            "--scheduler is for the backends dask, ray and slurm",
            f"wasp run SPEC --backend dask {EXAMPLES['dask']}",
        )
    if package is not None and find_spec(package) is None:
        raise UsageError(
            f"the backend {backend} needs the package '{package}'",
            f"pip install 'wasp-cli[{backend}]'",
        )
    if backend == "slurm":
        require_slurm(scheduler)
    elif scheduler is not None:
        _require_answer(backend, scheduler)
    elif backend == "dask":  # ray starts one of its own on this machine
        raise UsageError("the backend dask needs the address of its scheduler", EXAMPLES["dask"])


def pool_of(backend: str, jobs: int, scheduler: str | None) -> Pool:
    """Return the workers of a backend; of loky `jobs` processes, or with 0 this one, as with 1
    where no worker process can be started. dask and ray bring their own number.
    """
    if backend == "dask":
        return DaskPool(scheduler)
    if backend == "ray":
        return RayPool(scheduler)
    if backend == "slurm":
        return SlurmPool(jobs, scheduler)
    if jobs == 0:
        return InlinePool()
    if jobs == 1 and (reason := refusal_of_semaphores(jobs)) is not None:
        plain(f"no worker process can be started ({reason}): this process computes, as with -j 0")
        return InlinePool()
    return LokyPool(jobs)


def _passed_on(
    running: Future[NodeResult], translated: Callable[[BaseException], BaseException]
) -> Future[NodeResult]:
    result: Future[NodeResult] = Future()

    def told(ended: Future[NodeResult]) -> None:
        error = ended.exception()
        if error is None:
            result.set_result(ended.result())
        else:
            result.set_exception(translated(error))

    running.add_done_callback(told)
    return result


class InlinePool(Pool):
    name, local = "inline", True

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        done: Future[NodeResult] = Future()
        done.set_result(execute_here(job))
        return done

    def close(self, *, kill: bool = False) -> None: ...


class LokyPool(Pool):
    """joblib's loky workers: started on first use, so that torch is imported once in each."""

    name, local = LOCAL, True

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._crew: _Crew | None = None
        self._others: list[_Crew] = []  # of nodes alone, and those that were replaced
        # loky takes a loaded world model for a memory leak, replaces the worker and says so;
        # nothing is lost.
        warnings.filterwarnings(
            "ignore", message="A worker stopped while some jobs", category=UserWarning
        )

    def submit(self, job: NodeJob) -> Future[NodeResult]:
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
        """Let nodes that begin now have other workers, where these have had their time; what they
        still compute goes on.
        """
        if self._crew is not None and (self._crew.worn or self._crew.broken):
            self._others.append(self._crew)
            self._crew = None
        for crew in self._others:
            if crew.is_idle():
                crew.end(wait=False, kill=True)
        self._others = [crew for crew in self._others if not crew.is_idle()]

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        crew = _Crew(1)
        self._others.append(crew)
        result = crew.begin(job)
        result.add_done_callback(lambda _: crew.end(wait=False, kill=True))
        return result

    def close(self, *, kill: bool = False) -> None:
        for crew in (self._crew, *self._others):
            if crew is not None:
                crew.end(wait=not kill, kill=kill)
        self._crew, self._others = None, []


class _Crew:
    """Workers of one executor, and what they compute."""

    def __init__(self, count: int) -> None:
        self._workers = _new_workers(count)
        self._flying: list[Future[NodeResult]] = []
        self.broken = False  # one was killed, and all are gone
        self.worn = False  # code of others may still run in one that is to get no further node

    def begin(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node. Its future ends with WorkersDied where a worker was killed."""

        def translated(error: BaseException) -> BaseException:
            if not isinstance(error, BrokenExecutor):
                return error
            self.broken = True
            return WorkersDied(str(error))

        def looked_at(ended: Future[NodeResult]) -> None:
            if ended.exception() is None and ended.result().unclosed:
                self.worn = True

        with signals_wait():
            running: Future[NodeResult] = self._workers.submit(execute, job)
        running.add_done_callback(looked_at)
        self._flying = [running, *(other for other in self._flying if not other.done())]
        return _passed_on(running, translated)

    def is_idle(self) -> bool:
        """Return whether all nodes that were begun here have ended."""
        return all(running.done() for running in self._flying)

    def end(self, *, wait: bool, kill: bool) -> None:
        """End the workers: with `wait` after what they compute, with `kill` at once."""
        self._workers.shutdown(wait=wait, kill_workers=kill)


def _new_workers(count: int) -> Any:
    require_semaphores(count)
    from joblib.externals.loky import ProcessPoolExecutor

    return ProcessPoolExecutor(max_workers=count, initializer=start_worker, initargs=(os.getpid(),))


def start_worker(parent: int) -> None:
    """Prepare a worker process: being stopped is the parent's business, and without a parent
    there is nobody to work for.

    It leaves the terminal. Ctrl-C there would reach the processes of environments, which listen to
    it as processes do, while their nodes are to be finished.
    """
    leave_to_parent()
    lead_session()
    threading.Thread(target=_end_with, args=(parent,), daemon=True, name="parent-watch").start()


def _end_with(parent: int) -> None:
    """End this process with its parent, and soon after its own end: a thread that an environment
    has left behind would keep it for ever.
    """
    while os.getppid() == parent:
        if not threading.main_thread().is_alive():
            time.sleep(CLOSE_SECONDS)
            os._exit(0)
        time.sleep(1.0)
    os.killpg(0, signal.SIGKILL)  # with what it has started


class DaskPool(Pool):
    name = "dask"

    def __init__(self, scheduler: str | None) -> None:
        from distributed import Client

        self._starts = f"dask worker {scheduler} --nthreads 1 --nworkers N"
        try:
            self._client = Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise _no_answer(self.name, str(scheduler), error) from error
        threads = self._client.nthreads().values()
        if not threads or max(threads) > 1:
            self._client.close()
            several = (
                "a dask worker has several threads; nodes set threads, logs and memory of "
                "their whole process"
            )
            raise UsageError(
                several if threads else f"the dask scheduler at '{scheduler}' has no workers",
                self._starts,
            )
        self.jobs = len(threads)
        self._pending: set[Future[NodeResult]] = set()
        self._number = count()
        self._closed = threading.Event()
        threading.Thread(target=self._watch, daemon=True, name="dask-watch").start()

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        from distributed import KilledWorker

        result: Future[NodeResult] = Future()
        self._pending.add(result)

        def told(ended: Any) -> None:
            with suppress(InvalidStateError):  # it was given up meanwhile
                try:
                    error = ended.exception() if ended.status == "error" else None
                    if error is None and ended.status == "finished":
                        result.set_result(ended.result())
                    elif isinstance(error, KilledWorker):
                        result.set_exception(WorkersDied(str(error)))
                    else:
                        result.set_exception(_lost(described(error) if error else ended.status))
                except Exception as error:
                    # the scheduler died just now: what a worker computed cannot be fetched
                    result.set_exception(_lost(described(error)))
            self._pending.discard(result)

        self._client.submit(
            execute_here, job, key=f"{job.run_id}-{job.key}-{next(self._number)}", pure=False
        ).add_done_callback(told)
        return result

    def _watch(self) -> None:
        """Give up what is pending where the scheduler is gone: its futures would wait for ever.
        Look whether there are workers.
        """
        looked = time.monotonic()
        while not self._closed.wait(POLL_SECONDS):
            status = self._client.status
            if status not in ("running", "connecting"):
                for result in list(self._pending):
                    self._pending.discard(result)
                    with suppress(InvalidStateError):
                        result.set_exception(_lost(status))
            elif status == "running" and time.monotonic() - looked > COUNT_SECONDS:
                # whatever it says of a scheduler that goes away just now: the next look tells
                with suppress(Exception):
                    self.gone = None if self._client.nthreads() else self._starts
                looked = time.monotonic()

    def close(self, *, kill: bool = False) -> None:
        self._closed.set()
        with suppress(OSError, TimeoutError):
            self._client.close(timeout=CLOSE_SECONDS)


def _lost(reason: str) -> WaspError:
    return WaspError(
        f"the dask scheduler is lost ({reason})",
        "start it again, then run again: finished nodes are kept",
    )


def _require_answer(backend: str, address: str) -> None:
    """See that something listens at an address: the libraries' own attempts take minutes, and
    print what helps nobody.
    """
    match = re.fullmatch(r"(?:\w+://)?\[?([^/\]]+)\]?:(\d+)/?", address)
    if match is None:
        raise UsageError(
            f"'{address}' is not the address of a {backend} scheduler", EXAMPLES[backend]
        )
    try:
        socket.create_connection((match[1], int(match[2])), timeout=CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise _no_answer(backend, address, error) from error


def _no_answer(backend: str, address: str, error: Exception) -> UsageError:
    reason = " ".join(
        (getattr(error, "strerror", None) or str(error) or type(error).__name__).split()
    )
    return UsageError(
        f"no {backend} scheduler answers at '{address}': {reason[:200].lower()}", STARTS[backend]
    )


class RayPool(Pool):
    name = "ray"

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
        def translated(error: BaseException) -> BaseException:
            # ray has many ways to say that a worker or its machine is gone
            return (
                error
                if isinstance(error, self._ray.exceptions.RayTaskError)
                else WorkersDied(str(error))
            )

        return _passed_on(self._execute.remote(job).future(), translated)

    def close(self, *, kill: bool = False) -> None:
        self._ray.shutdown()


def slurm_options(text: str | None) -> dict[str, str | int]:
    """Parse `KEY=VALUE,...`, options of sbatch as submitit names them: `partition=cpu,time=720`
    (minutes). Raises UsageError.
    """
    options: dict[str, str | int] = {}
    for part in filter(None, (text or "").split(",")):
        match = re.fullmatch(r"\s*([a-z_]+)=(\S+)\s*", part)
        if match is None:
            raise UsageError(f"'{part}' is no option of sbatch", EXAMPLES["slurm"])
        options[match[1]] = int(match[2]) if match[2].isdigit() else match[2]
    return options


def require_slurm(text: str | None) -> None:
    """See that jobs can be submitted from here with these options. Raises UsageError."""
    from submitit import SlurmExecutor

    if None in (shutil.which("sbatch"), shutil.which("srun")):
        raise UsageError(
            "the backend slurm needs sbatch and srun, which are not on this machine",
            "run it on a login node of the cluster",
        )
    try:
        SlurmExecutor("slurm").update_parameters(**slurm_options(text))
    except ValueError as error:
        said, *known = re.split(r"\n\s+- (\w+) .*", str(error))
        raise UsageError(
            said.partition("\n")[0], f"it knows {', '.join(filter(str.strip, known))}"
        ) from error


class SlurmPool(Pool):
    name = "slurm"

    def __init__(self, jobs: int, options: str | None) -> None:
        self.jobs = max(jobs, 1)
        self._options = slurm_options(options)
        self._executor: Any = None
        # the Slurm job of each result that has not come yet
        self._pending: dict[Future[NodeResult], Any] = {}
        self._closed = threading.Event()
        threading.Thread(target=self._watch, daemon=True, name="slurm-watch").start()

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        from submitit import SlurmExecutor

        result: Future[NodeResult] = Future()
        try:
            if self._executor is None:
                self._executor = SlurmExecutor(
                    Layout(Path(job.root)).run(job.run_id) / "slurm", max_num_timeout=0
                )
            threads = int(self._options.get("cpus_per_task", job.threads))
            self._executor.update_parameters(
                job_name="wasp", **{**self._options, "cpus_per_task": threads}
            )
            self._pending[result] = self._executor.submit(
                execute_here, replace(job, threads=threads)
            )
        except Exception as error:  # sbatch refuses in many ways
            reason = " ".join(str(error).split())[-300:]
            # it may take the next one, and others run
            result.set_exception(WorkersDied(f"Slurm takes no job: {reason}"))
        return result

    def _watch(self) -> None:
        while not self._closed.wait(5 * POLL_SECONDS):
            for result, job in list(self._pending.items()):
                if not job.done():
                    continue
                del self._pending[result]
                try:
                    result.set_result(job.result())
                except Exception as error:
                    # submitit raises one kind for a killed job, another for one that could not
                    # begin
                    # its last words, which name the cause
                    result.set_exception(WorkersDied(" ".join(str(error).split())[-300:]))

    def close(self, *, kill: bool = False) -> None:
        self._closed.set()
        for job in list(self._pending.values()):  # one may end meanwhile
            job.cancel(check=False)
