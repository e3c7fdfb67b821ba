"""Stored episodes played again bit for bit, without the assistant that was there.

    rerun = Rerun(task, model, operator, Recorded(**read_recorded(path)))
    for moment in rerun:                      # before each decision is carried out
        task.snapshot(), operator.snapshot()  # the state in which it was made, after the operator's
        command

The episodes of a batch run side by side as they were evaluated, since products of matrices may
round by their number of rows. T_e = decisions of episode e, B = episodes, A = action size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.learning.closed_loop import Filter, privileged_view
from wasp_cli.learning.playback import Floats32, other_episode, play, require_same, side_by_side
from wasp_cli.models.base import Latent
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import Operator
from wasp_cli.tasks.base import Observation, VectorTask


class Recorded(NamedTuple):
    """What brings the B episodes of a cell back, and what shows that they are the same; as
    `store.recorded` reads it.
    """

    layouts: Sequence[int]  # [B] seeds of the worlds
    a_h: Sequence[Floats32]  # [T_e, A] per episode: commands within the bounds
    a: Sequence[Floats32]  # [T_e, A] per episode: executed actions
    reward: Sequence[Floats32]  # [T_e] per episode
    first: int = 0  # number of the first of them within their cell

    def of(self, episodes: range) -> Recorded:
        """Return what brings some of the episodes back, which were evaluated side by side."""
        part = slice(episodes.start, episodes.stop)
        return Recorded(
            self.layouts[part],
            self.a_h[part],
            self.a[part],
            self.reward[part],
            self.first + episodes.start,
        )


class Moment(NamedTuple):
    """A decision of B episodes, before its action is carried out. Rows whose episodes are over
    mean nothing.
    """

    t: int
    seen: Observation
    latent: Latent  # [B, .] filtered
    a_h: Tensor  # [B, A] the command that the operator has just issued, within the bounds
    action: Tensor  # [B, A] what was executed; zero in rows whose episodes are over
    alive: NDArray[np.bool_]  # [B] the episode was still going when the decision was made


class Rerun:
    """See the module. It can be iterated once: the operator's noise goes on.

    Args:
        task: of B = the recorded episodes, with what the model reads.
        model: the world model of the cell, used as the filter.
        operator: of the cell, with B fresh rows.
        recorded: the episodes.
    """

    def __init__(
        self, task: VectorTask, model: SafetyWorldModel, operator: Operator, recorded: Recorded
    ) -> None:
        if task.batch != len(recorded.a):
            raise ValueError(f"a task of {task.batch} rows for {len(recorded.a)} episodes")
        self.task, self.operator, self.recorded = task, operator, recorded
        self.filter = Filter(model, task.batch)
        self.lengths = np.array([len(actions) for actions in recorded.a])  # [B] T_e
        for e, actions in enumerate(recorded.a):
            if actions.shape[1:] != (task.action_size,):
                raise other_episode(
                    recorded.first + e,
                    task.batch,
                    0,
                    f"an action has {task.action_size} numbers, a recorded one {actions.shape[-1]}",
                )

    @torch.inference_mode()
    def __iter__(self) -> Iterator[Moment]:
        """Every decision, before it is carried out; what is held with it may be read until the
        next one is asked for.
        """
        commands = side_by_side(self.recorded.a_h)
        first = torch.ones(self.task.batch)
        for played in play(
            self.task,
            self.recorded.layouts,
            self.recorded.a,
            self.recorded.reward,
            number=self.recorded.first,
        ):
            if not played.alive.any():
                return
            latent = self.filter.see(played.observation, first)
            first = torch.zeros(self.task.batch)
            a_h = self.operator.command(
                latent.features, privileged_view(self.operator, played.observation)
            ).clamp(-1, 1)
            require_same(
                played.t,
                played.alive,
                "the command of the operator is",
                a_h.numpy(),
                commands[played.t],
                number=self.recorded.first,
            )
            action = torch.from_numpy(played.action)
            yield Moment(played.t, played.observation, latent, a_h, action, played.alive)
            self.filter.executed(action)
            self.operator.observe(action)
