"""Every node as a Slurm job of its own, submitted through submitit."""

from __future__ import annotations

import re
import shutil
import threading
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

from wasp_cli.errors import UsageError
from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.pools.base import POLL_SECONDS, Pool, WorkersDied
from wasp_cli.run.worker import execute_here
from wasp_cli.store.layout import Layout

EXAMPLE = "--scheduler partition=cpu,time=720,mem=8GB"


def slurm_options(text: str | None) -> dict[str, str | int]:
    """Parse `KEY=VALUE,...`, options of sbatch as submitit names them: `partition=cpu,time=720`
    (minutes).

    Raises:
        UsageError: a part is not of that form.
    """
    options: dict[str, str | int] = {}
    for part in filter(None, (text or "").split(",")):
        match = re.fullmatch(r"\s*([a-z_]+)=(\S+)\s*", part)
        if match is None:
            raise UsageError(f"'{part}' is not an option of sbatch", EXAMPLE)
        options[match[1]] = int(match[2]) if match[2].isdigit() else match[2]
    return options


def require_slurm(text: str | None) -> None:
    """Check that jobs can be submitted from here with these options.

    Raises:
        UsageError: Slurm's programs are not on this machine, or there is no such option.
    """
    from submitit import SlurmExecutor

    if shutil.which("sbatch") is None or shutil.which("srun") is None:
        raise UsageError(
            "the backend slurm needs sbatch and srun, which are not on this machine",
            "run it on a login node of the cluster",
        )
    try:
        SlurmExecutor("slurm").update_parameters(**slurm_options(text))
    except ValueError as error:
        # submitit lists what it knows, one option a line
        said, *known = re.split(r"\n\s+- (\w+) .*", str(error))
        raise UsageError(
            said.partition("\n")[0], f"it knows {', '.join(filter(str.strip, known))}"
        ) from error


class SlurmPool(Pool):
    """Slurm jobs, one for each node."""

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
        """Submit a node as a Slurm job. If Slurm refuses it, its future ends with WorkersDied."""
        from submitit import SlurmExecutor

        result: Future[NodeResult] = Future()
        threads = int(self._options.get("cpus_per_task", job.threads))
        try:
            if self._executor is None:
                folder = Layout(Path(job.root)).run(job.run_id) / "slurm"
                self._executor = SlurmExecutor(folder, max_num_timeout=0)
            options = {**self._options, "cpus_per_task": threads}
            self._executor.update_parameters(job_name="wasp", **options)
            work = replace(job, threads=threads)
            self._pending[result] = self._executor.submit(execute_here, work)
        except Exception as error:  # sbatch raises many kinds of errors
            # Only this node fails: others run, and Slurm may accept the next one.
            result.set_exception(WorkersDied(f"Slurm takes no job: {_last_words(error)}"))
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
                    # submitit raises different errors for a job that was killed and for one that
                    # could not begin.
                    result.set_exception(WorkersDied(_last_words(error)))

    def close(self, *, kill: bool = False) -> None:
        """Cancel all jobs that have not ended, with `kill` or without."""
        self._closed.set()
        for job in list(self._pending.values()):  # one may end meanwhile
            job.cancel(check=False)


def _last_words(error: Exception) -> str:
    """The end of what an error says, which names the cause, on one line."""
    return " ".join(str(error).split())[-300:]
