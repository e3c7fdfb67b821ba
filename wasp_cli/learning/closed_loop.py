"""The closed loop: task, filter, operator and assistant, B episodes side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.methods.base import Assistant, Decision, checked
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator
from wasp_cli.tasks.base import Observation, Step, VectorTask

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class DecisionColumns:
    """What is recorded of a decision of B episodes side by side; the only place that lists it.

    Each field is [B, ...] for one decision, and [T, B, ...] for the T decisions of a `Loop`.
    """

    reward: Array  # [B] sum over the env steps of the decision
    cost: Array  # [B] bool, any cost in the decision
    cost_env: Array  # [B] env steps with cost
    env_steps: Array  # [B] env steps executed
    goals: Array  # [B] goals reached
    alive: Array  # [B] bool, the episode was still going when the decision was made
    terminated: Array  # [B] bool, the decision ended the episode by the task's own rule
    a_h: Array  # [B, A] the operator's command within the bounds
    action: Array  # [B, A] the executed action

    @classmethod
    def of(cls, step: Step, a_h: Tensor, action: Tensor, alive: Array) -> DecisionColumns:
        """Copy the columns of one decision.

        Args:
            step: what the decision led to.
            a_h: [B, A] commands within the bounds.
            action: [B, A] executed actions.
            alive: [B] whether each episode was still going when the decision was made.
        """
        return cls(
            reward=np.array(step.reward),
            cost=np.array(step.cost),
            cost_env=np.array(step.cost_env),
            env_steps=np.array(step.env_steps),
            goals=np.array(step.goals),
            alive=np.array(alive),
            terminated=np.array(step.terminated & alive),
            a_h=np.array(a_h.cpu().numpy()),
            action=np.array(action.cpu().numpy()),
        )


@dataclass(frozen=True, eq=False)
class Loop(DecisionColumns):
    """What T decisions of B episodes left behind. After the end of an episode its columns mean
    nothing: `alive` says which entries count.
    """

    decisions: list[Decision]  # [T]
    decision_ms: Array  # [T] wall time of `decide` in milliseconds, divided by the batch
    h: Tensor | None  # [T, B, D] filtered latents; None where they were not kept
    z: Tensor | None  # [T, B, Z] like `h`

    @classmethod
    def joined(
        cls,
        columns: Sequence[DecisionColumns],
        decisions: list[Decision],
        decision_ms: Sequence[float],
        latents: Sequence[Latent] = (),
    ) -> Loop:
        """Stack T decisions.

        Args:
            columns: [T] what was recorded of each.
            decisions: [T] what the assistant answered.
            decision_ms: [T] how long it took, in milliseconds.
            latents: [T] filtered latents [B, .]; none leaves `h` and `z` at None.
        """
        names = [field.name for field in fields(DecisionColumns)]
        stacked = {name: np.stack([getattr(row, name) for row in columns]) for name in names}
        h = None
        z = None
        if latents:
            h = torch.stack([latent.h for latent in latents])
            z = torch.stack([latent.z for latent in latents])
        return cls(
            **stacked,
            decisions=decisions,
            decision_ms=np.array(decision_ms, np.float32),
            h=h,
            z=z,
        )


def batches(begin: int, episodes: int, size: int) -> list[range]:
    """Return which episodes of a cell run side by side: `size` at a time, the last batch with what
    is left.

    Args:
        begin: number of episodes that exist already, in whole batches.
        episodes: number of episodes of the cell.
        size: episodes of a batch.
    """
    return [range(first, min(first + size, episodes)) for first in range(begin, episodes, size)]


class Perception(Protocol):
    """What the loop needs of a world model: `models.base.WorldModel` and `models.state.StateWorld`
    have it.
    """

    action_size: int

    @property
    def reads(self) -> str:
        """The field of an observation that it sees: `pixels` or `state`."""
        ...

    def initial(self, batch: int) -> Latent:
        """Return the latents [B, .] before the first observation, for `batch` rows."""
        ...

    def filter(self, latent: Latent, action: Tensor, seen: Tensor, first: Tensor) -> Latent:
        """Return the latents [B, .] after actions [B, A] and what was then seen [B, ...]; rows with
        `first` [B] start from the initial latent.
        """
        ...


class Filter:
    """The world model's filter over a running batch of episodes."""

    def __init__(self, model: Perception, batch: int) -> None:
        self.model = model
        self.latent = model.initial(batch)
        self.device = self.latent.h.device
        self._action = torch.zeros(batch, model.action_size, device=self.device)

    def see(self, observation: Observation, first: Tensor) -> Latent:
        """Return the latents [B, .] after a new observation; rows with `first` [B] start anew."""
        seen = torch.from_numpy(getattr(observation, self.model.reads)).to(self.device)
        self.latent = self.model.filter(self.latent, self._action, seen, first.to(self.device))
        return self.latent

    def executed(self, action: Tensor) -> None:
        """Tell the filter which actions [B, A] were executed."""
        self._action = action


def privileged_view(operator: Operator, observation: Observation) -> Tensor | None:
    """Return the privileged observation [B, P] for an operator who knows more than assistants
    perceive; None for any other operator.
    """
    if not operator.knows_more:
        return None
    assert observation.privileged is not None
    return torch.from_numpy(observation.privileged)


@torch.inference_mode()
def run_episodes(
    task: VectorTask,
    model: Perception,
    operator: Operator,
    assistant: Assistant,
    layout_seeds: Sequence[int],
    method_seeds: Sequence[int],
    *,
    keep_latents: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> Loop:
    """Run one episode per row, until all have ended.

    Args:
        task: B episodes with what the model reads. For an operator who knows more than assistants
            perceive, its observations are privileged too.
        model: filters the observations into latents.
        operator: of B rows, fresh.
        assistant: decides; it is reset for all rows.
        layout_seeds: [B] seeds of the worlds.
        method_seeds: [B] seeds of the assistant's own draws.
        keep_latents: also return the filtered latents.
        progress: called every 25 decisions with the share of the time limit and a text.

    Returns:
        The T decisions, T being that of the longest episode.

    Raises:
        WaspError: the assistant answered with something other than a valid decision (see
            `methods.base.checked`).
    """
    # -- begin every episode
    batch = task.batch
    observation = task.reset(layout_seeds)
    filter_ = Filter(model, batch)
    first = torch.ones(batch)
    assistant.reset(torch.ones(batch, dtype=torch.bool), method_seeds)
    # An assistant may skip the work for episodes that have ended.
    rest: Callable[[Tensor], None] | None = getattr(assistant, "rest", None)
    columns: list[DecisionColumns] = []
    decisions: list[Decision] = []
    times: list[float] = []
    latents: list[Latent] = []
    ended = np.zeros(batch, bool)
    for t in range(task.max_decisions):
        # -- perceive
        latent = filter_.see(observation, first)
        first = torch.zeros(batch)

        # -- command and decide; `checked` compares the command with its copy
        a_h = operator.command(latent.features, privileged_view(operator, observation))
        a_h = a_h.clamp(-1, 1)
        command = a_h.clone()
        begin = time.perf_counter()
        decision = assistant.decide(latent, a_h, operator)
        times.append((time.perf_counter() - begin) * 1000 / batch)
        action = checked(decision, assistant, a_h, command).action

        # -- act
        filter_.executed(action)
        operator.observe(action)
        step = task.step(action.cpu().numpy())

        # -- record
        columns.append(DecisionColumns.of(step, a_h, action, ~ended))
        decisions.append(decision)
        if keep_latents:
            latents.append(latent)

        # -- go on with the episodes that are left
        if rest is not None and (step.ended & ~ended).any():
            rest(torch.from_numpy(step.ended))
        observation = step.observation
        ended = step.ended.copy()
        if progress is not None and t % 25 == 0:
            progress((t + 1) / task.max_decisions, f"decision {t + 1}/{task.max_decisions}")
        if ended.all():
            break
    return Loop.joined(columns, decisions, times, latents)
