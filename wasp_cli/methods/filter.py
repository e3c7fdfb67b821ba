"""A safety filter that looks one step ahead (after Oh et al. 2025, the human-centred safety
filter): the strongest rule without rollouts.

    Q_c(h, z, a) = c-hat(x') + gamma_c V_c(x'),  x' = x'(h, z, a) the imagined next state

is the cost that an action is expected to have. A command for which it is at most tau_c stands.
Elsewhere the first such action on the segment from the command to the safest action is executed, or
the safest action itself where there is none. The original's fallback is a learned policy; here the
safest of some actions is sought, since a bang-bang motor has few.

B episodes, A actions, K candidates, P points of the segment, M imagined next states, Z Gumbel
variables of each, N held-out decisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import FilterConfig
from wasp_cli.methods.noise import DecisionNoise, Streams, as_gumbel
from wasp_cli.methods.quantiles import distributions, quantile
from wasp_cli.methods.record import blank_record, chosen
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator

FALLBACK = 0.5  # tau_c where it is to be calibrated and no calibration exists
# What a decision draws for besides the imagined next states: the actions among which the safest is
# sought.
CORRECTION = 1
CHUNK = 256  # held-out decisions that are looked at together


class SafetyFilter:
    """See the module."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(FilterConfig, config)
        self.model = parts.world_model
        self.gamma_c = parts.gamma_c
        critics = load_module(LatentCritics, parts.inputs["critics"] / "critics.safetensors")
        self.critics = critics.to(parts.device)
        if self.config.tau_c == "calibrated":
            self.tau_c = parts.thresholds.get("tau_c", FALLBACK)
        else:
            self.tau_c = float(self.config.tau_c)
        self.noise = DecisionNoise(parts.device)

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool), with one seed for each of the B rows."""
        self.noise.reset(rows, seeds)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the commands a_h [B, A], corrected where their Q_c is above tau_c. The signal is
        Q_c [B] of the command.
        """
        # What the command costs.
        streams = self.noise.streams()
        draws = self._draws(streams)
        cost = self.q_c(latent, a_h.unsqueeze(1), draws).squeeze(1)  # [B]
        unsafe = cost > self.tau_c

        # Correct it where that is too much.
        action = a_h.clone()
        record = blank_record(len(a_h), device=a_h.device)._replace(signal=cost)
        rows = chosen(unsafe)
        if len(rows):
            shape = (self.config.candidates, a_h.shape[1])
            (uniforms,) = streams.uniform(shape, purpose=CORRECTION, rows=rows)
            corrected = self._corrected(latent.rows(rows), a_h[rows], draws[rows], uniforms)
            action[rows] = torch.where(unsafe[rows].unsqueeze(-1), corrected, a_h[rows])
            record = record._replace(gate=(GATE_METHOD * unsafe).to(torch.int8))
        return Decision(action, record)

    def q_c(self, latent: Latent, actions: Tensor, draws: Tensor) -> Tensor:
        """Return Q_c [B, K], in discounted costly decisions: actions [B, K, A] are executed once,
        and the nominal expert goes on.

        Args:
            latent: [B, .] where the actions are executed.
            actions: [B, K, A] within the bounds.
            draws: Gumbel [B, M, Z], shared by the K actions of a row (common random numbers).
        """
        batch, candidates, size = actions.shape
        rollouts = draws.shape[1]
        copies = candidates * rollouts
        action = actions.unsqueeze(2).expand(-1, -1, rollouts, -1).reshape(batch * copies, size)
        noise = draws.unsqueeze(1).expand(-1, candidates, -1, -1).reshape(batch * copies, -1)
        arrived = self.model.imagine(latent.expand_rows(copies), action, noise)  # [B * K * M, .]
        keep = self.model.continues(arrived)  # nothing costs after the end of an episode
        cost = self.model.cost(arrived) + self.gamma_c * keep * self.critics.value_c(arrived)
        return cost.view(batch, candidates, rollouts).mean(-1)

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set tau_c to a quantile of Q_c [N] under the expert, over decisions without cost
        after them; return it with the distributions.
        """
        # Q_c of the expert's commands.
        total = len(heldout.a_h)
        self.reset(torch.ones(total, dtype=torch.bool), [seed + i for i in range(total)])
        draws = self._draws(self.noise.streams())
        chunks = torch.arange(total, device=draws.device).split(CHUNK)
        parts = [
            self.q_c(heldout.latent.rows(rows), heldout.a_h[rows].unsqueeze(1), draws[rows])
            for rows in chunks
        ]
        cost = torch.cat(parts).squeeze(1)  # [N]

        free_cost = cost[cost_ahead == 0]
        if self.config.tau_c == "calibrated":
            if len(free_cost):
                self.tau_c = quantile(free_cost, self.config.quantile)
            else:
                self.tau_c = FALLBACK
        return {
            "tau_c": self.tau_c,
            **distributions({"q_c": cost, "q_c_free": free_cost}),
            "expert_rate": float((cost > self.tau_c).float().mean()),
        }

    def _corrected(self, latent: Latent, a_h: Tensor, draws: Tensor, uniforms: Tensor) -> Tensor:
        """Return the least correction [B, A] along the segment from a_h to the safest candidate.

        Args:
            latent: [B, .].
            a_h: [B, A].
            draws: Gumbel [B, M, Z].
            uniforms: [B, K, A] in [0, 1), of which random candidates are made.
        """
        # Candidates: a stop, random actions, and the corners, where motors saturate, unless they
        # are more than the candidates.
        batch, actions = a_h.shape
        everyone = torch.arange(batch, device=a_h.device)
        fixed = [[0.0] * actions]
        if 2**actions <= self.config.candidates:
            corners = [list(corner) for corner in product((-1.0, 1.0), repeat=actions)]
            fixed = corners + fixed
        fixed_actions = torch.tensor(fixed, device=a_h.device).expand(batch, -1, -1)
        candidates = torch.cat([fixed_actions, 2 * uniforms - 1], 1)
        safest = candidates[everyone, self.q_c(latent, candidates, draws).argmin(1)]  # [B, A]

        # P points on the way there; the last one is the safest action.
        count = self.config.segment
        shares = torch.arange(1, count + 1, device=a_h.device).view(1, -1, 1) / count
        points = torch.lerp(a_h.unsqueeze(1), safest.unsqueeze(1), shares)  # [B, P, A]

        # The first of them that is safe, or the last.
        safe = self.q_c(latent, points, draws) <= self.tau_c
        safe[:, -1] = True
        first = safe.to(torch.int8).argmax(1)  # argmax gives the first of equal values
        return points[everyone, first]

    def _draws(self, streams: Streams) -> Tensor:
        """Return Gumbel draws [B, M, Z]."""
        (uniforms,) = streams.uniform((self.config.rollouts, self.model.noise_size))
        return as_gumbel(uniforms)
