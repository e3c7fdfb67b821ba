"""The nodes of a run as Slurm jobs, through submitit: each node is a job of its own.

The results folder has to be seen under the same path by every machine, and the source has to be the same there. What the jobs print, and
their batch scripts, lie in `runs/RUN/slurm` of the results folder.
"""

from __future__ import annotations

import re
import shutil
import threading
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from pathlib import Path
from typing import Any

from wasp_cli.errors import UsageError, WaspError
from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.pool import Pool, WorkersDied
from wasp_cli.run.worker import execute_here
from wasp_cli.store.layout import Layout

EXAMPLE = "--scheduler partition=cpu,time=720,mem=8GB"
POLL_SECONDS = 0.5


def slurm_options(text: str | None) -> dict[str, str | int]:
    """Parse `KEY=VALUE,...`, options of sbatch as submitit names them: `partition=cpu,time=720` (minutes). Raises UsageError."""
    options: dict[str, str | int] = {}
    for part in filter(None, (text or "").split(",")):
        match = re.fullmatch(r"\s*([a-z_]+)=(\S+)\s*", part)
        if match is None:
            raise UsageError(f"'{part}' is no option of sbatch", EXAMPLE)
        options[match[1]] = int(match[2]) if match[2].isdigit() else match[2]
    return options


def require_slurm(text: str | None) -> None:
    """See that jobs can be submitted from here, and that submitit knows the options. Raises UsageError."""
    from submitit import SlurmExecutor

    if None in (shutil.which("sbatch"), shutil.which("srun")):
        raise UsageError("the backend slurm needs sbatch and srun, which are not on this machine", "run it on a login node of the cluster")
    try:
        SlurmExecutor("slurm").update_parameters(**slurm_options(text))
    except ValueError as error:
        said, _, known = str(error).partition("Valid parameters are:")
        names = ", ".join(re.findall(r"- (\w+) ", known))
        raise UsageError(f"submitit passes no such option to sbatch: {said.strip().split(': ')[-1]}", f"it knows {names}") from error


class SlurmPool(Pool):
    """Slurm jobs, at most `jobs` of them at a time."""

    name = "slurm"

    def __init__(self, jobs: int, options: str | None) -> None:
        self.jobs = max(jobs, 1)
        self._options = slurm_options(options)
        self._executor: Any = None
        self._pending: dict[Future[NodeResult], Any] = {}
        """The Slurm job of each result that has not come yet."""
        self._closed = threading.Event()
        threading.Thread(target=self._watch, daemon=True, name="slurm-watch").start()

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        result: Future[NodeResult] = Future()
        try:
            submitted = self._executor_of(job).submit(execute_here, job)
        except Exception as error:  # sbatch refuses in many ways
            said = " ".join(str(error).split())
            result.set_exception(WaspError(f"Slurm takes no job: {said[-300:]}", f"options of sbatch: {EXAMPLE}"))
        else:
            self._pending[result] = submitted
        return result

    def _executor_of(self, job: NodeJob) -> Any:
        from submitit import SlurmExecutor

        if self._executor is None:
            folder = Layout(Path(job.root)).run(job.run_id) / "slurm"
            self._executor = SlurmExecutor(folder, max_num_timeout=0)
        self._executor.update_parameters(job_name="wasp", **{"cpus_per_task": job.threads, **self._options})
        return self._executor

    def _watch(self) -> None:
        """Pass on results as they come."""
        while not self._closed.wait(POLL_SECONDS):
            for result, job in list(self._pending.items()):
                if not job.done():
                    continue
                del self._pending[result]
                with suppress(InvalidStateError):
                    try:
                        result.set_result(job.result())
                    except Exception as error:  # submitit raises one kind for a killed job, another for one that could not begin
                        result.set_exception(WorkersDied(" ".join(str(error).split())[:300]))

    def close(self, *, kill: bool = False) -> None:
        self._closed.set()
        for job in self._pending.values():
            job.cancel(check=False)
