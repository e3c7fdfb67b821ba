"""The planner with nobody at the controls: what WASP's own search reaches where no command has to
stand.

A reference row, and as much of a ceiling as the model allows. At every decision the constrained
search of WASP (`methods.wasp.search`) looks for the best action sequence of which at most tau_c
costly decisions are expected, by its imagined rewards with V_r behind the horizon. It starts from
the expert's actions, as TD-MPC and SafeDreamer start from their policies: a candidate is what is
added to them in the first L decisions, and the expert goes on afterwards. To add nothing is a
candidate of every iteration. Nothing of an operator is read.

A plan replaces the expert's actions only where it gains tau_r, or where they are not safe: a search
prefers plans about which the model errs. On Race1 plans with an imagined gain of .26 and .21
imagined costly decisions within H had 1.22 in the task, and were no faster.

B episodes, R of them decided, L steps, A actions.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Parts
from wasp_cli.methods.configs import PlannerConfig
from wasp_cli.methods.record import blank_record, chosen
from wasp_cli.methods.wasp.assistant import GATES, WASP, Look
from wasp_cli.methods.wasp.imagine import imagination_of
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator


class Planner(WASP):
    """See the module. Imagination, search and memory of the last plan are WASP's."""

    def __init__(self, config: Config, parts: Parts) -> None:
        super().__init__(
            cast(PlannerConfig, config), imagination_of(parts), {}, parts.motors, parts.device
        )

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Plan, whatever the commands a_h [B, A] are. `gate` says where the action is another one,
        the signal is the predicted cost [B] of the plan.
        """
        # Imagine the expert's actions, and the expert afterwards.
        streams = self.noise.streams()
        here = chosen(~self.resting)  # indices [R]
        expert = self.imagination.expert(latent.features).clamp(-1, 1)  # [B, A]
        start = self._situation(latent, expert, here)
        draws = self._draws(streams, GATES, start)
        nothing_added = self.plan.new_zeros(len(here), 1, *self.plan.shape[1:])
        future = self._scored(start, nothing_added, draws)

        # Search from there. WASP's search begins with two futures that its gates saw, those of a
        # command and of a correction; here both are the expert's.
        twice = future.take(torch.zeros(len(here), 2, dtype=torch.long, device=expert.device))
        look = Look(start.a_h, twice, twice.cost[:, 0], draws)
        plan = self._search(start, look, streams)

        # Execute the first action of the plan.
        self.plan = torch.zeros_like(self.plan)
        self.plan[here] = plan.residuals
        action = (expert + self.plan[:, 0]).clamp(-1, 1)
        gate = GATE_METHOD * (action != a_h).any(-1)
        record = blank_record(len(a_h), device=a_h.device)._replace(gate=gate.to(torch.int8))
        record.signal[here] = plan.cost
        return Decision(action, record)
