"""Stored episodes played again bit for bit, without the assistant that was there.

    rerun = Rerun(task, model, operator, Recorded(**read_recorded(path)))
    for moment in rerun:                      # before each decision is carried out
        task.snapshot(), operator.snapshot()  # the state in which it was made, after the operator's command

A task gives the same for the same actions, the filter draws nothing, and what an operator draws depends on the episode and the decision
alone, so that the executed actions bring every state back. All episodes of a cell run side by side as they were evaluated, since the
products of matrices may round by their number of rows. T_e = decisions of episode e, B = episodes, A = action size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.errors import ArtifactError
from wasp_cli.learning.closed_loop import Filter
from wasp_cli.models.base import Latent
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import Operator
from wasp_cli.tasks.base import Observation, VectorTask

Floats32 = NDArray[np.float32]


class Recorded(NamedTuple):
    """What brings the B episodes of a cell back, and what shows that they are the same; as `store.recorded` reads it."""

    layouts: Sequence[int]
    """[B] seeds of the worlds"""
    a_h: Sequence[Floats32]
    """[T_e, A] per episode: commands within the bounds"""
    a: Sequence[Floats32]
    """[T_e, A] per episode: executed actions"""
    reward: Sequence[Floats32]
    """[T_e] per episode"""


class Moment(NamedTuple):
    """A decision of B episodes, before its action is carried out. Rows whose episodes are over mean nothing."""

    t: int
    seen: Observation
    latent: Latent
    """[B, .] filtered"""
    a_h: Tensor
    """[B, A] the command that the operator has just issued, within the bounds"""
    action: Tensor
    """[B, A] what was executed; zero in rows whose episodes are over"""
    alive: NDArray[np.bool_]
    """[B] the episode was still going when the decision was made"""


class Rerun:
    """See the module. It can be iterated once: the operator's noise goes on.

    Args:
        task: of B = the recorded episodes, with pixels.
        model: the world model of the cell, used as the filter.
        operator: of the cell, with B fresh rows.
        recorded: the episodes.
    """

    def __init__(self, task: VectorTask, model: SafetyWorldModel, operator: Operator, recorded: Recorded) -> None:
        if task.batch != len(recorded.a):
            raise ValueError(f"a task of {task.batch} rows for {len(recorded.a)} episodes")
        self.task, self.operator, self.recorded = task, operator, recorded
        self.filter = Filter(model, task.batch)
        self.lengths = np.array([len(actions) for actions in recorded.a])
        """[B] T_e"""
        for e, actions in enumerate(recorded.a):
            if actions.shape[1:] != (task.action_size,):
                raise _other(e, 0, f"an action of the task has {task.action_size} numbers, a recorded one {actions.shape[-1]}")

    @torch.inference_mode()
    def __iter__(self) -> Iterator[Moment]:
        """Every decision, before it is carried out; what is held with it may be read until the next one is asked for.

        Raises:
            ArtifactError: commands, rewards or ends of the episodes are not those that were recorded.
        """
        batch, rows = self.task.batch, range(self.task.batch)
        commands, actions, rewards = (_side_by_side(part) for part in (self.recorded.a_h, self.recorded.a, self.recorded.reward))
        seen = self.task.reset(self.recorded.layouts)
        first = torch.ones(batch)
        for t in range(len(actions)):
            latent = self.filter.see(seen, first)
            first = torch.zeros(batch)
            a_h = self.operator.command(latent.features).clamp(-1, 1)
            alive = t < self.lengths
            self._compare(t, alive, "the command of the operator is", a_h.numpy(), commands[t])
            action = torch.from_numpy(actions[t])
            yield Moment(t, seen, latent, a_h, action, alive)
            self.filter.executed(action)
            step = self.task.step(actions[t])
            self._compare(t, alive, "the reward is", step.reward.astype(np.float32), rewards[t])
            for e in rows:
                if alive[e] and step.ended[e] != (t + 1 == self.lengths[e]):
                    raise _other(e, t, f"the episode {'ends' if step.ended[e] else 'goes on'} here")
            seen = step.observation

    def _compare(self, t: int, alive: NDArray[np.bool_], what: str, found: Floats32, recorded: Floats32) -> None:
        """Refuse what is not recorded: [B, ...] each."""
        same = (found == recorded).reshape(len(alive), -1).all(1)
        wrong = np.flatnonzero(alive & ~same)
        if wrong.size:
            e = int(wrong[0])
            raise _other(e, t, f"{what} {found[e].tolist()} here, and {recorded[e].tolist()} was recorded")


def _side_by_side(episodes: Sequence[Floats32]) -> Floats32:
    """[T_e, ...] per episode as [T, B, ...], zero after the ends; T is that of the longest."""
    longest = max(map(len, episodes))
    padded = np.zeros((longest, len(episodes), *np.shape(episodes[0])[1:]), np.float32)
    for e, values in enumerate(episodes):
        padded[: len(values), e] = values
    return padded


def _other(episode: int, t: int, what: str) -> ArtifactError:
    return ArtifactError(
        f"played again, episode {episode} is not the recorded one from decision {t} on: {what}",
        "the cell was computed by other code, other libraries or on another sort of machine; run it again here",
    )
