"""Stored episodes played again bit for bit, without their assistant.

    rerun = Rerun(task, model, operator, Recorded(**read_recorded(path)))
    for moment in rerun:
        # The decision was made in this state, after the operator's command.
        world = task.snapshot()
        memory = operator.snapshot()

The episodes of a batch run side by side as they were evaluated, because a product of matrices may
round differently with another number of rows. T_e decisions of episode e, B episodes, A components
of an action.
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
    """The B episodes of a cell, as `store.recorded` reads them: what they are played from, and what
    they are compared with.
    """

    layouts: Sequence[int]  # [B] seeds of the worlds
    a_h: Sequence[Floats32]  # by episode [T_e, A]: commands within the bounds
    a: Sequence[Floats32]  # by episode [T_e, A]: executed actions
    reward: Sequence[Floats32]  # by episode [T_e]
    first: int = 0  # number of the first episode within the cell

    def of(self, episodes: range) -> Recorded:
        """Return some of the episodes, which were evaluated side by side."""
        part = slice(episodes.start, episodes.stop)
        return Recorded(
            self.layouts[part],
            self.a_h[part],
            self.a[part],
            self.reward[part],
            self.first + episodes.start,
        )


class Moment(NamedTuple):
    """A decision of B episodes, before its action is carried out. Rows whose episodes are over mean
    nothing.
    """

    t: int
    seen: Observation
    latent: Latent  # [B, .] filtered
    a_h: Tensor  # [B, A] the command that the operator has just issued, within the bounds
    action: Tensor  # [B, A] the executed action; zero in rows whose episodes are over
    alive: NDArray[np.bool_]  # [B] the episode was still going when the decision was made


class Rerun:
    """See the module. It can be iterated once, because the operator's noise goes on.

    Args:
        task: of as many episodes as are recorded, with what the model reads.
        model: the world model of the cell, which filters.
        operator: of the cell, with B fresh rows.
        recorded: the B episodes.

    Raises:
        ValueError: the task has another number of episodes.
        ArtifactError: the task has another action size.
    """

    def __init__(
        self, task: VectorTask, model: SafetyWorldModel, operator: Operator, recorded: Recorded
    ) -> None:
        if task.batch != len(recorded.a):
            raise ValueError(f"a task of {task.batch} rows for {len(recorded.a)} episodes")
        self.task = task
        self.operator = operator
        self.recorded = recorded
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
        """Yield every decision before its action is carried out. What it holds may be read until
        the next one is taken.

        Raises:
            ArtifactError: a command or reward differs from the recorded one.
        """
        recorded = self.recorded
        commands = side_by_side(recorded.a_h)
        first = torch.ones(self.task.batch)
        episodes = play(
            self.task, recorded.layouts, recorded.a, recorded.reward, number=recorded.first
        )
        for played in episodes:
            if not played.alive.any():
                return

            # -- perceive and command again
            latent = self.filter.see(played.observation, first)
            first = torch.zeros(self.task.batch)
            privileged = privileged_view(self.operator, played.observation)
            a_h = self.operator.command(latent.features, privileged).clamp(-1, 1)
            require_same(
                played.t,
                played.alive,
                "the command of the operator is",
                a_h.numpy(),
                commands[played.t],
                number=recorded.first,
            )

            # -- the decision; its action is carried out when the next one is taken
            action = torch.from_numpy(played.action)
            yield Moment(played.t, played.observation, latent, a_h, action, played.alive)
            self.filter.executed(action)
            self.operator.observe(action)
