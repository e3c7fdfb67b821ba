"""What is sent to a worker and what comes back: names and plain values, never tensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal


@dataclass(frozen=True)
class NodeJob:
    """What a worker has to know to compute a node."""

    root: str  # the results folder
    run_id: str
    kind: str
    key: str
    label: str
    task: str
    seed: int
    stage: str  # import string of the stage's class
    axes: Mapping[str, Any]
    config: Mapping[str, Any]
    settings: Mapping[str, Any]
    inputs: Mapping[str, tuple[str, str]]
    """Kind and key of the artifacts that it reads, by the name under which its stage reads them."""
    sources: Mapping[str, str]  # hash by module of the code that decides the result
    earlier: str | None = None
    """Key of the same artifact with fewer episodes, whose rows may be taken over."""
    attempt: int = 1
    threads: int = 1
    limit: float | None = None  # seconds that it may take; None for no limit
    provenance: Mapping[str, Any] = field(default_factory=dict)
    folders: tuple[str, ...] = ()  # where modules that the spec names may lie


State = Literal["done", "shared", "failed", "busy", "skipped", "unseen"]


@dataclass(frozen=True)
class NodeResult:
    """How a node ended."""

    key: str
    state: State
    """`shared`: another run has computed it; `busy`: another run computes it now; `skipped`: the
    run was asked to stop; `unseen`: the worker does not see the results folder.
    """
    seconds: float
    summary: Mapping[str, Any] = field(default_factory=dict)
    message: str = ""
    hint: str | None = None
    log: str = ""
    by_chance: bool = False
    """Whether a failure may be due to chance (a full disk, memory, an unexpected error), so that
    another attempt may succeed.
    """
    unclosed: tuple[str, ...] = ()
    """What went wrong when the environments of the node were closed; the node itself is done."""
    short: bool = False
    """Whether a failure is that of a strict run: the node is stored, and falls short of its bar."""
