"""What assistants see of a task: camera images, or its vector where it shows no image."""

from __future__ import annotations

from typing import Literal

from wasp_cli.tasks.registry import TASKS


def seen_of(task: str) -> Literal["pixels", "state"]:
    """Return the field of `Observation` that assistants see; no other field of it reaches them."""
    return "state" if TASKS[task].cameras == 0 else "pixels"
