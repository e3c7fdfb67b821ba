"""What travels to a worker and what comes back (names and plain values, never tensors), and what every pool of workers offers."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol


@dataclass(frozen=True)
class NodeJob:
    """One node for one worker."""

    root: str
    """The results folder."""
    run_id: str
    kind: str
    key: str
    label: str
    task: str
    seed: int
    stage: str
    """Import string of the stage's class."""
    axes: Mapping[str, Any]
    config: Mapping[str, Any]
    settings: Mapping[str, Any]
    inputs: Mapping[str, tuple[str, str]]
    """Kind and key of the upstream artifacts, by the name under which the stage reads them."""
    sources: Mapping[str, str]
    """Hash by module of the code that decides the result."""
    earlier: str | None = None
    """Key of the same artifact with fewer episodes, whose rows may be taken over."""
    attempt: int = 1
    threads: int = 1
    limit: float | None = None
    """Seconds that it may take; None for no limit."""
    wait: bool = False
    """Whether to wait while another run computes it; otherwise it comes back as `busy`."""
    provenance: Mapping[str, Any] = field(default_factory=dict)


State = Literal["done", "shared", "failed", "cancelled", "busy", "skipped", "unseen"]


@dataclass(frozen=True)
class NodeResult:
    """How a node ended.

    `shared`: another run computed it meanwhile; `busy`: another run computes it now; `cancelled`: it was taken back; `skipped`: the run is
    to end; `unseen`: its worker does not see the results folder.
    """

    key: str
    state: State
    seconds: float
    summary: Mapping[str, Any] = field(default_factory=dict)
    message: str = ""
    """Cause of a failure, in one line."""
    hint: str | None = None
    log: str = ""
    by_chance: bool = False
    """Whether a failure may come from the moment (a full disk, memory, a bug that needs luck), so that another attempt may succeed."""


class WorkersDied(Exception):
    """A worker process was killed; the results that were not yet given are lost, artifacts are not."""


class Pool(Protocol):
    """Computes nodes side by side."""

    jobs: int
    """Nodes at once; 0 is counted as 1, in this process."""
    name: str
    """As the journal has it."""

    gone: str | None
    """How to start workers, where all have gone and what was given to them waits; None as long as there are some."""

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node; nobody submits more than `jobs` at a time.

        The future ends with WorkersDied where a worker was killed, perhaps that of another node. The pool can be used again.
        """
        ...

    def alone(self, job: NodeJob) -> Future[NodeResult]:
        """Begin to compute a node in a process of its own. The future ends with WorkersDied where that process was killed."""
        ...

    def close(self, *, kill: bool = False) -> None:
        """End the workers; with `kill`, at once."""
        ...
