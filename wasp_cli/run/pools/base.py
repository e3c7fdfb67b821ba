"""What workers of a run are to its runner.

Only jobs travel to them: keys, paths and plain values. Each node is a task of its own, since what
it needs is only there when another one ends. Every machine has to see the results folder under the
same path and to run the same source: a worker that does not refuses to publish.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from concurrent.futures import Future

from wasp_cli.run.job import NodeJob, NodeResult

POLL_SECONDS = 0.1


class WorkersDied(Exception):
    """A worker process was killed; the results that were not yet given are lost, artifacts are
    not.
    """


class Pool(ABC):
    """Workers that compute the nodes of one run."""

    name = ""
    jobs = 1
    """How many nodes are computed at once."""
    local = False
    """Whether nodes share this machine, and one process that is killed takes the others along."""
    gone: str | None = None
    """How to start workers, if all have gone and submitted nodes wait; None as long as there are
    some.
    """

    @abstractmethod
    def submit(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node; nobody submits more than `jobs` at a time.

        The future ends with WorkersDied if any worker was killed.
        """

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node in a process of its own, if the pool can."""
        return self.submit(job)

    @abstractmethod
    def close(self, *, kill: bool = False) -> None:
        """End the workers; with `kill`, at once."""
