"""The contract of a stage, which turns upstream artifacts into one artifact."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

from wasp_cli.config import Config

Progress = Callable[[float, str], None]
"""Called with the finished share in [0, 1] and a short text such as 'update 300/800, loss 41.2'."""


def no_progress(share: float, text: str) -> None:
    """Do nothing: the callback of callers that show no progress."""


@dataclass(frozen=True)
class Job:
    """One node's work, as a worker receives it."""

    kind: str
    task: str
    seed: int  # of the training chain; it is part of the names of all random streams
    config: Config  # the validated section of this stage (an instance of the stage's `config`)
    settings: Mapping[
        str, Any
    ]  # the shared settings of the spec that the stage lists in `settings`
    axes: Mapping[str, Any]  # what else identifies the node, such as method, operator and value
    inputs: Mapping[str, Path]  # folders of the upstream artifacts, by stage kind
    out_dir: Path  # empty folder; what the stage leaves there becomes the artifact
    work_dir: Path  # survives an interruption; resumable stages keep their checkpoint here
    progress: Progress = field(default=no_progress)
    earlier: Path | None = None
    """Folder of the same artifact with fewer episodes, whose rows may be taken over. The result is
    the same with and without it.
    """
    threads: int = 1
    """Threads of physics and cameras. They vary with the number of nodes that run side by side, and
    no result depends on them.
    """


class Stage(Protocol):
    """A node kind. Heavy imports go inside `run`, so that planning needs no torch.

    A class may also have `needs_informed`, kinds that it reads on tasks whose operators know more
    than assistants perceive, and `needs_auto`, kinds that it reads where a number of its section is
    `auto`.

    A class may set `torch_threads`, the threads of linear algebra in this stage; otherwise there is
    one. It is a constant of the stage and not an option of the run, because another number may
    round differently, and the same key must give the same bytes.
    """

    kind: ClassVar[str]
    config: ClassVar[type[Config]]
    settings: ClassVar[tuple[str, ...]]
    """Names of shared settings of the spec that enter the node's configuration and key."""
    needs: ClassVar[tuple[str, ...]]
    """Stage kinds of the same task and seed whose artifacts `run` reads (methods add theirs in
    `evaluate` and `calibration`).
    """

    def run(self, job: Job) -> Mapping[str, Any]:
        """Fill `job.out_dir`, and return the numbers of the summary: JSON values, which are stored
        in the manifest.
        """
        ...
