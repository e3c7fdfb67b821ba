"""A cell of the grid, as people name it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from wasp_cli.operators.registry import UNIMPAIRED


@dataclass(frozen=True, order=True, slots=True)
class Cell:
    """One point of the evaluation grid: who assists whom, where, with which seed."""

    task: str
    method: str
    assistant: str
    """Ablation of the method; 'full' for the method itself."""
    operator: str
    """Operator variant; `UNIMPAIRED` for the reference row."""
    severity: str | None
    """Name of the severity in the spec; enters no key."""
    value: float | None
    """Value of the severity."""
    seed: int

    def __str__(self) -> str:
        assistant = "" if self.assistant == "full" else f"/{self.assistant}"
        operator = "unimpaired" if self.operator == UNIMPAIRED else f"{self.operator}={self.value:g}"
        return f"{self.task} {self.method}{assistant} {operator} seed {self.seed}"

    def as_json(self) -> dict[str, Any]:
        """As plain values, for the plan of a run."""
        # dataclasses.asdict copies every value deeply, which takes seconds over a large grid.
        return {name: getattr(self, name) for name in _FIELDS}


_FIELDS = tuple(field.name for field in fields(Cell))
