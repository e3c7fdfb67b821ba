"""How many cores a run may use, and how many threads a node: by this process's affinity, the
control groups of its container, service or Slurm job, and the user's variables.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

# what limits a container, a service and a Slurm job, on Linux
CGROUP = Path("/sys/fs/cgroup")
OWN_CGROUP = Path("/proc/self/cgroup")
SLURM_CORES = "SLURM_CPUS_ON_NODE"
THREADS = ("OMP_NUM_THREADS", "OMP_THREAD_LIMIT", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Variables by which a user limits the threads of a process."""


def cores() -> int:
    """Return how many cores this process may use: the least of its affinity, the share of time of
    its control groups, and what Slurm gave its job on this machine.
    """
    affinity = getattr(os, "sched_getaffinity", None)  # Linux only
    counts = [len(affinity(0)) if affinity is not None else os.cpu_count() or 1]
    for share, period in _shares():
        counts.append(math.ceil(share / period))
    slurm = _count(os.environ.get(SLURM_CORES, ""))
    if slurm is not None:
        counts.append(slurm)
    return min(counts)


def memory_limit() -> int | None:
    """Return the bytes of memory that the control groups of this process allow; None without a
    limit.
    """
    limits = [*_numbers("", "memory.max"), *_numbers("memory", "memory.limit_in_bytes")]
    return min((size for (size,) in limits), default=None)


def thread_limit() -> tuple[str, int] | None:
    """Return the user's variable that allows a process the fewest threads, and how many; None
    without any. A value that is not a number is no limit, as in OpenMP.
    """
    limits = []
    for name in THREADS:
        # A list has a number for each level of nested loops, of which we have one.
        count = _count(os.environ.get(name, "").partition(",")[0])
        if count is not None:
            limits.append((name, count))
    return min(limits, key=lambda limit: limit[1], default=None)


def threads_here() -> int:
    """Return how many threads a computation may use if nothing else runs beside it."""
    limit = thread_limit()
    if limit is None:
        return cores()
    return min(cores(), limit[1])


def _count(text: str) -> int | None:
    """A positive whole number in a text; None if it is anything else."""
    match = re.fullmatch(r"\s*\+?(\d{1,9})\s*", text)
    if match is None:
        return None
    return int(match[1]) or None


def _shares() -> Iterator[tuple[int, int]]:
    # Without a limit the files have the word "max", or -1.
    for numbers in (
        *_numbers("", "cpu.max"),
        *_numbers("cpu", "cpu.cfs_quota_us", "cpu.cfs_period_us"),
    ):
        if len(numbers) == 2 and numbers[0] > 0:
            yield numbers[0], numbers[1]


def _numbers(controller: str, *names: str) -> Iterator[list[int]]:
    """The numbers in files of every control group that this process is in: of version 2, or of
    version 1 with the name of its `controller`.
    """
    for folder in _groups(controller):
        with suppress(OSError, ValueError):  # the file is not there, or has no number
            texts = [(folder / name).read_text(encoding="ascii") for name in names]
            yield [int(word) for text in texts for word in text.split()]


def _groups(controller: str) -> Iterator[Path]:
    """The folder of each group from the outermost to that of this process; a limit of any of them
    counts.
    """
    root = CGROUP / controller
    yield root
    with suppress(OSError):
        for line in OWN_CGROUP.read_text(encoding="utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if controller in controllers.split(","):
                inner = Path(path.lstrip("/"))
                yield from (root / part for part in (*inner.parents, inner) if part != Path())
