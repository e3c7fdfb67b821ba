"""What the runner of a run knows about its workers.

Workers get only jobs: keys, paths and plain values. Each node is a task of its own, since its
inputs are there only when other nodes have ended. Every machine has to see the results folder under
the same path and to run the same source; a worker that does not refuses to store results.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from concurrent.futures import Future

from wasp_cli.run.job import NodeJob, NodeResult

POLL_SECONDS = 0.1


class WorkersDied(Exception):
    """A worker process was killed. Results that it had not returned are lost, stored artifacts are
    not.
    """


class Pool(ABC):
    """Workers that compute the nodes of one run."""

    name = ""
    jobs = 1
    """How many nodes are computed at once."""
    local = False
    """Whether nodes run on this machine, where a process that is killed ends the others too."""
    gone: str | None = None
    """How to start workers, if all have gone and submitted nodes wait; None while there are any."""

    @abstractmethod
    def submit(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node; the runner has at most `jobs` of them at a time.

        The future ends with WorkersDied if a worker was killed.
        """

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node in a process of its own, if the pool can."""
        return self.submit(job)

    @abstractmethod
    def close(self, *, kill: bool = False) -> None:
        """End the workers; with `kill`, at once."""
