"""The closed loop: task, filter, operator and assistant, B episodes side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.methods.base import Assistant, Decision, checked
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator
from wasp_cli.tasks.base import Observation, VectorTask

Array = NDArray[Any]


class Loop(NamedTuple):
    """What B episodes left behind, by decision step: [T, B] unless said. After an episode's end
    only rows of `alive` count.
    """

    reward: Array
    cost: Array
    cost_env: Array
    env_steps: Array
    goals: Array
    alive: Array  # [T, B] the episode was still going when the decision was made
    terminated: Array  # [T, B] the decision ended the episode by the task's own rule
    a_h: Array  # [T, B, A] the operator's command within the bounds
    action: Array  # [T, B, A] the executed action
    decisions: list[Decision]  # [T]
    decision_ms: Array  # [T] wall time of `decide` in milliseconds, divided by the batch
    h: Tensor | None  # [T, B, D] filtered latents, when asked for
    z: Tensor | None


def batches(begin: int, episodes: int, size: int) -> list[range]:
    """Return which episodes of a cell meet side by side: `size` at a time, the last batch with what
    is left.

    Args:
        begin: how many are there already, in whole batches.
    """
    return [range(first, min(first + size, episodes)) for first in range(begin, episodes, size)]


class Perception(Protocol):
    """What the loop asks of a world model (`models.base.WorldModel`, `models.state.StateWorld`)."""

    action_size: int

    @property
    def reads(self) -> str:
        """The field of an observation that it sees: `pixels` or `state`."""
        ...

    def initial(self, batch: int) -> Latent: ...

    def filter(self, latent: Latent, action: Tensor, seen: Tensor, first: Tensor) -> Latent: ...


class Filter:
    """The world model's filter over a running batch of episodes."""

    def __init__(self, model: Perception, batch: int) -> None:
        self.model = model
        self.latent = model.initial(batch)
        self.device = self.latent.h.device
        self._action = torch.zeros(batch, model.action_size, device=self.device)

    def see(self, observation: Observation, first: Tensor) -> Latent:
        """Return the latents [B, .] after a new observation; rows with `first` [B] start anew."""
        read = getattr(observation, self.model.reads)
        self.latent = self.model.filter(
            self.latent, self._action, torch.from_numpy(read).to(self.device), first.to(self.device)
        )
        return self.latent

    def executed(self, action: Tensor) -> None:
        """Tell the filter which actions [B, A] were executed."""
        self._action = action


def told(operator: Operator, observation: Observation) -> Tensor | None:
    """Return what an operator who knows more than assistants perceive reads, [B, P]; None for
    one who does not.
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
        task: B episodes with what the model reads, and for an informed operator with privileged
            observations.
        operator: of B rows, fresh.
        assistant: decides; it is reset for all rows.
        keep_latents: also return the filtered latents.
    """
    batch = task.batch
    seen = task.reset(layout_seeds)
    filter_ = Filter(model, batch)
    first = torch.ones(batch)
    assistant.reset(torch.ones(batch, dtype=torch.bool), method_seeds)
    names = (
        "reward",
        "cost",
        "cost_env",
        "env_steps",
        "goals",
        "alive",
        "terminated",
        "a_h",
        "action",
    )
    rows: dict[str, list[Array]] = {name: [] for name in names}
    decisions: list[Decision] = []
    times: list[float] = []
    kept: list[Latent] = []
    ended = np.zeros(batch, bool)
    # no work for episodes that have ended
    rest: Callable[[Tensor], None] | None = getattr(assistant, "rest", None)
    for t in range(task.max_decisions):
        latent = filter_.see(seen, first)
        first = torch.zeros(batch)
        a_h = operator.command(latent.features, told(operator, seen)).clamp(-1, 1)
        given = a_h.clone()
        begun = time.perf_counter()
        decision = assistant.decide(latent, a_h, operator)
        times.append((time.perf_counter() - begun) * 1000 / batch)
        action = checked(decision, assistant, a_h, given).action
        filter_.executed(action)
        operator.observe(action)
        step = task.step(action.cpu().numpy())
        for name, value in (
            ("reward", step.reward),
            ("cost", step.cost),
            ("cost_env", step.cost_env),
            ("env_steps", step.env_steps),
            ("goals", step.goals),
            ("alive", ~ended),
            ("terminated", step.terminated & ~ended),
            ("a_h", a_h.cpu().numpy()),
            ("action", action.cpu().numpy()),
        ):
            rows[name].append(np.array(value))
        decisions.append(decision)
        if keep_latents:
            kept.append(latent)
        if rest is not None and (step.ended & ~ended).any():
            rest(torch.from_numpy(step.ended))
        seen, ended = step.observation, step.ended.copy()
        if progress is not None and t % 25 == 0:
            progress((t + 1) / task.max_decisions, f"decision {t + 1}/{task.max_decisions}")
        if ended.all():
            break
    stacked = {name: np.stack(values) for name, values in rows.items()}
    h = torch.stack([latent.h for latent in kept]) if keep_latents else None
    z = torch.stack([latent.z for latent in kept]) if keep_latents else None
    return Loop(**stacked, decisions=decisions, decision_ms=np.array(times, np.float32), h=h, z=z)
