"""Operators who know more than assistants perceive: in the task they follow the privileged policies
(`TaskInfo.informed`).

In imagination there is nothing privileged: there they follow the latent policy of the same skill.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from wasp_cli.models.policy import load_privileged
from wasp_cli.operators.base import Policy
from wasp_cli.tasks.registry import TASKS
from wasp_cli.tasks.sight import seen_of


def observed(task: str) -> tuple[str, ...]:
    """Return what a task has to show where operators drive it and assistants see it."""
    return (seen_of(task), "privileged") if TASKS[task].informed else (seen_of(task),)


def informed_policies(
    task: str, inputs: Mapping[str, Path], device: torch.device | None = None
) -> Callable[[float], Policy] | None:
    """Return the policies of operators in a task by skill, on privileged observations [B, P]; None
    where they perceive what assistants do.

    Args:
        inputs: artifact folders by stage kind; that of the expert is read.
    """
    if not TASKS[task].informed:
        return None

    @cache
    def at(fraction: float) -> Policy:
        policy = load_privileged(inputs["expert"], fraction).to(device)

        def command(privileged: Tensor) -> Tensor:
            intended: Tensor = policy(privileged.to(device))
            return intended

        return command

    return at
