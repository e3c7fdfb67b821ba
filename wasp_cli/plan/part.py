"""A trained part of a spec, as people name it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, order=True, slots=True)
class Part:
    """What one training stage leaves for a task, a seed and a round."""

    task: str
    kind: str
    seed: int
    """The seed of the training chain."""
    round: int = 1

    def __str__(self) -> str:
        return f"{self.task} s{self.seed} {self.kind}" + (f", round {self.round}" if self.round > 1 else "")

    def as_json(self) -> dict[str, Any]:
        """As plain values, for the plan of a run."""
        return asdict(self)
