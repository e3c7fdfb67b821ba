"""The contract of a stage: what turns upstream artifacts into one artifact."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

from wasp_cli.config import Config

Progress = Callable[[float, str], None]
"""Called with the finished share in [0, 1] and a short text such as 'update 300/800, loss 41.2'."""


def no_progress(share: float, text: str) -> None:
    """Ignore progress: the callback of callers that show none."""


@dataclass(frozen=True)
class Job:
    """One node's work, as a worker receives it."""

    kind: str
    task: str
    seed: int  # names the random streams of this node; every node of a training chain has the same
    config: Config  # the validated section of this stage (an instance of the stage's `config`)
    # the spec's shared settings that the stage named in its `settings`, and no others
    settings: Mapping[str, Any]
    # what else identifies the node: method, variant, value (evaluate, calibration)
    axes: Mapping[str, Any]
    inputs: Mapping[str, Path]  # folders of the upstream artifacts, by stage kind
    out_dir: Path  # empty folder; what the stage leaves there becomes the artifact
    work_dir: Path  # survives an interruption; resumable stages keep their checkpoint here
    progress: Progress = field(default=no_progress)
    earlier: Path | None = None
    """Folder of the same artifact with fewer episodes, whose rows may be taken over; what comes
    out is the same with and without it.
    """
    # for physics and cameras, whose results do not depend on it: it varies with how many nodes run
    # side by side
    threads: int = 1


class Stage(Protocol):
    """A node kind. Heavy imports go inside `run`, so that planning needs no torch.

    A class may name further `needs_informed`, which it reads on tasks whose operators know more
    than assistants perceive, and `needs_auto`, which it reads where a number of its section is
    `auto`.

    A class may set `torch_threads` (1 where it does not): threads of linear algebra in this stage.
    It is a constant of the stage and not an option of the run, because another number may round
    differently, and the same key must give the same bytes.
    """

    kind: ClassVar[str]
    config: ClassVar[type[Config]]
    # names of shared spec settings that enter the node's configuration and key
    settings: ClassVar[tuple[str, ...]]
    needs: ClassVar[tuple[str, ...]]
    """Stage kinds of the same task and seed whose artifacts `run` reads (methods add theirs in
    `evaluate` and `calibration`).
    """

    def run(self, job: Job) -> Mapping[str, Any]:
        """Fill `job.out_dir` and return the numbers worth showing (JSON values; they go to the
        manifest).
        """
        ...
