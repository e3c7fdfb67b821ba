"""Operators who know more than assistants perceive (`TaskInfo.informed`). In the task they follow
the privileged policies.

Nothing is privileged in imagination, so there they follow the latent policy of the same skill.
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
    """Return the observations that a task has to show where operators drive and assistants see."""
    if TASKS[task].informed:
        return (seen_of(task), "privileged")
    return (seen_of(task),)


def informed_policies(
    task: str, inputs: Mapping[str, Path], device: torch.device | None = None
) -> Callable[[float], Policy] | None:
    """Return the policies that operators follow in a task.

    Args:
        task: its name.
        inputs: artifact folders by stage kind; that of the expert is read.
        device: where the policies compute; None is the CPU.

    Returns:
        From a fraction of training to a policy on privileged observations [B, P]; None for a task
        whose operators perceive what assistants do.
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
