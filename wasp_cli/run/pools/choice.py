"""Which workers `--backend` and `--scheduler` ask for."""

from __future__ import annotations

from importlib.util import find_spec

from wasp_cli.console import plain
from wasp_cli.errors import UsageError
from wasp_cli.run.pools import dask, slurm
from wasp_cli.run.pools.base import Pool
from wasp_cli.run.pools.local import InlinePool, LokyPool
from wasp_cli.run.shared_memory import refusal_of_semaphores

LOCAL = "loky"
PACKAGES = {"dask": "distributed", "slurm": "submitit"}
"""By backend the package that it needs, which is an extra of ours of the same name."""
BACKENDS = (LOCAL, *PACKAGES)


def require_backend(backend: str, scheduler: str | None) -> None:
    """Check that a backend can be used: its package is installed, and its scheduler answers.

    Raises:
        UsageError: it cannot, or `scheduler` is given to a backend that has none.
    """
    package = PACKAGES.get(backend)
    if package is None:
        if scheduler is not None:
            raise UsageError(
                "--scheduler is for the backends dask and slurm",
                f"wasp run SPEC --backend dask {dask.EXAMPLE}",
            )
        return
    if find_spec(package) is None:
        raise UsageError(
            f"the backend {backend} needs the package '{package}'",
            f"pip install 'wasp-cli[{backend}]'",
        )
    if backend == "slurm":
        slurm.require_slurm(scheduler)
    else:
        dask.require_scheduler(scheduler)


def pool_of(backend: str, jobs: int, scheduler: str | None) -> Pool:
    """Return the workers of a backend.

    Args:
        backend: loky, dask or slurm.
        jobs: processes of loky; 0 computes in this process, and so does 1 if no worker process can
            be started. For Slurm, jobs at a time. dask has its own number.
        scheduler: address of dask; options of sbatch for Slurm.
    """
    if backend == "dask":
        return dask.DaskPool(scheduler)
    if backend == "slurm":
        return slurm.SlurmPool(jobs, scheduler)
    if jobs == 0:
        return InlinePool()
    if jobs == 1:
        reason = refusal_of_semaphores(jobs)
        if reason is not None:
            plain(
                f"no worker process can be started ({reason}): this process computes, as with -j 0"
            )
            return InlinePool()
    return LokyPool(jobs)
