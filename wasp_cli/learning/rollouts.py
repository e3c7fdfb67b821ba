"""Episodes of an assistant in the real task, recorded as a dataset has them: the states that only assistance creates.

B = episodes side by side, A = action size, T = decision steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.dataset import record
from wasp_cli.learning.shards import Recording
from wasp_cli.methods.base import Assistant
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import NoiseSource, Operator, OperatorContext, build_operator
from wasp_cli.operators.mixed import MixedOperator
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.tasks.base import VectorTask


def in_turn(ladder: Mapping[str, Sequence[float]], context: OperatorContext, noise: NoiseSource, batch: int, first: int) -> MixedOperator:
    """Build the operators of a batch of episodes: the unimpaired one, then every severity of every variant, then from the beginning.

    Args:
        ladder: severities by variant.
        context: what the operators are built from.
        noise: of the batch.
        batch: episodes side by side.
        first: index of the first episode among all; it decides who drives whom.
    """
    named: list[tuple[str, float | None]] = [(UNIMPAIRED, None)]
    named += [(variant, value) for variant in sorted(ladder) for value in ladder[variant]]
    mixed = MixedOperator([build_operator(variant, value, context, noise, batch) for variant, value in named], noise, seed=0)
    mixed.choice = (first + torch.arange(batch)) % len(named)
    return mixed


def assisted_episodes(
    task: VectorTask,
    model: SafetyWorldModel,
    operator: Operator,
    assistant: Assistant,
    layout_seeds: Sequence[int],
    method_seeds: Sequence[int],
    name: str,
    number: int,
    progress: Callable[[float, str], None] | None = None,
) -> Recording:
    """Record one episode per row as a shard, with the actions that the assistant executed.

    Each episode runs twice: the assistant decides, and what it executed is carried out again before the recorder of the dataset. A task
    gives the same for the same actions, and its cameras take a small part of the time that the planner takes.

    Args:
        task: B episodes with pixels and privileged observations.
        model: the filter of the assistant.
        operator: of B rows, fresh.
        assistant: decides.
        layout_seeds: of the worlds.
        method_seeds: of the assistant's own sampling.
        name: the behaviour.
        number: index of the first episode in the dataset.
        progress: told of the decisions.
    """
    loop = run_episodes(task, model, operator, assistant, layout_seeds, method_seeds, progress=progress)
    return record(task, layout_seeds, Playback(loop.action).command, [name] * task.batch, number)


class Playback:
    """Commands that are already known: [T, B, A]. After the last one it stays, for tasks that are not quite repeatable."""

    def __init__(self, action: NDArray[np.float32]) -> None:
        self._action, self._now = action, 0

    def command(self, privileged: NDArray[Any]) -> NDArray[np.float32]:
        """Return the next actions [B, A], whatever is seen."""
        now: NDArray[np.float32] = self._action[min(self._now, len(self._action) - 1)]
        self._now += 1
        return now
