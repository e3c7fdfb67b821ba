"""MPMI: many inputs are imagined at once, and of those that are safe the one nearest to the command
is executed.

After Broad, Murphey and Argall (RSS 2019, arXiv:1906.02318; code: asbroad/mpmi_shared_control).
There is no task gate, no search and no learned value, so that a comparison with WASP shows what
these add. As in the authors' code

- an input is held over the whole horizon, the command too;
- inputs lie evenly over the bounds, the same ones at every decision;
- where no input is safe, the command stands: they call it a failure of the system, and leave it to
  the operator;
- an input is executed as it was imagined. That motors saturate, so that another input may have the
  same force and be nearer, is not exploited.

The horizon is five decisions, .4 s on Goal1 and .8 s on the cars; theirs is .3 and .4 s. Within the
fifteen decisions of WASP an expert's held input leaves the road, so that tau_c means little, and
commands are replaced too late.

What differs from the source:

- The model is the latent world model in place of a Koopman operator.
- Safe is what the safety gate of WASP means by it: costly decisions within H, discounted, a mean
  over rollouts on common draws. Theirs is a distance to the edge on one trajectory.
- The command is one of the inputs, so that it stands where it is safe. Theirs is moved to the grid,
  which is a hundredth wide.
- The distance is Euclidean. Their code for the race car has fourth powers of gas and brake.

tau_c is calibrated as that of the safety filter. WASP's number does not fit: an expert who keeps
holding an input costs more than one who goes on steering.

B episodes, K inputs, M rollouts, H horizon, A actions, Z Gumbel variables, N held-out decisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import MPMIConfig
from wasp_cli.methods.noise import DecisionNoise, Streams, as_gumbel
from wasp_cli.methods.quantiles import distributions, quantile
from wasp_cli.methods.record import blank_record, chosen
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Situation, over_rollouts
from wasp_cli.methods.wasp.returns import discounted_sum
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Critics, Latent
from wasp_cli.operators.base import DrawnNoise, Operator

FALLBACK = 0.5  # tau_c where it is to be calibrated and no calibration exists
CHUNK = 64  # held-out decisions that are looked at together


class MPMI:
    """See the module."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(MPMIConfig, config)
        no_critics = cast(Critics, None)  # nothing is valued beyond the horizon
        model = parts.world_model
        self.imagination = Imagination(
            model, no_critics, parts.skills.expert, parts.gamma_r, parts.gamma_c, parts.lam
        )
        if self.config.tau_c == "calibrated":
            self.tau_c = parts.thresholds.get("tau_c", FALLBACK)
        else:
            self.tau_c = float(self.config.tau_c)
        self.noise = DecisionNoise(parts.device)
        # A Sobol sequence lies as evenly as a grid, for any number of inputs and actions; its
        # second point is a stop.
        points = torch.quasirandom.SobolEngine(model.action_size).draw(self.config.candidates)
        self.inputs = 2 * points.to(parts.device) - 1  # [K, A]

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool), with one seed for each of the B rows."""
        self.noise.reset(rows, seeds)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the commands a_h [B, A]; where holding one costs more than tau_c, the nearest
        safe input. The signal is that cost [B].
        """
        # What it costs to hold the command.
        draws = self._draws(self.noise.streams())
        cost = self.g_c(latent, a_h.unsqueeze(1), draws).squeeze(1)  # [B]
        unsafe = cost > self.tau_c

        # Where that is too much, imagine all inputs.
        action = a_h.clone()
        record = blank_record(len(a_h), device=a_h.device)._replace(signal=cost)
        rows = chosen(unsafe)
        if len(rows):
            inputs = self.inputs.expand(len(rows), -1, -1)  # [R, K, A]
            input_cost = self.g_c(latent.rows(rows), inputs, draws.rows(rows))
            nearest, any_safe = nearest_safe(a_h[rows], inputs, input_cost, self.tau_c)
            intervenes = unsafe[rows] & any_safe
            action[rows] = torch.where(intervenes.unsqueeze(-1), nearest, a_h[rows])
            record.gate[rows] = (GATE_METHOD * intervenes).to(torch.int8)
        return Decision(action, record)

    def g_c(self, latent: Latent, inputs: Tensor, draws: Draws) -> Tensor:
        """Return the costly decisions [B, K] within H, discounted, of holding inputs [B, K, A] from
        latent states [B, .] on.

        Args:
            latent: [B, .] where the inputs begin.
            inputs: [B, K, A] within the bounds.
            draws: of M rollouts; every input meets them (common random numbers).
        """
        batch, candidates, size = inputs.shape
        held = over_rollouts(inputs.unsqueeze(2), self.config.rollouts).squeeze(1)  # [R, A]
        nothing_drawn = DrawnNoise(held.new_zeros(0, 1, 0))
        holding = Operator(lambda features: held, size, nothing_drawn, batch)
        start = Situation(latent, inputs[:, 0], holding, torch.arange(batch, device=inputs.device))
        imagined = self.imagination.roll(start, candidates, lambda k, command: held, draws)
        keep = imagined.continues()
        cost = discounted_sum(imagined.cost(), self.imagination.gamma_c, keep)  # [B, K, M]
        return cost.mean(-1)

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set tau_c to a quantile of G_c [N] under the expert, over decisions without cost
        after them; return it with the distributions.
        """
        # What it costs to hold the expert's commands.
        total = len(heldout.a_h)
        self.reset(torch.ones(total, dtype=torch.bool), [seed + i for i in range(total)])
        draws = self._draws(self.noise.streams())
        chunks = torch.arange(total, device=heldout.a_h.device).split(CHUNK)
        parts = [
            self.g_c(heldout.latent.rows(rows), heldout.a_h[rows].unsqueeze(1), draws.rows(rows))
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
            **distributions({"g_cost": cost, "g_cost_free": free_cost}),
            "expert_rate": float((cost > self.tau_c).float().mean()),
        }

    def _draws(self, streams: Streams) -> Draws:
        """Return draws of M rollouts; the operator, who holds an input, draws nothing."""
        shape = (self.config.horizon, self.config.rollouts, self.imagination.model.noise_size)
        (uniforms,) = streams.uniform(shape)
        return Draws(as_gumbel(uniforms), uniforms.new_zeros(*uniforms.shape[:3], 0))


def nearest_safe(a_h: Tensor, inputs: Tensor, cost: Tensor, tau_c: float) -> tuple[Tensor, Tensor]:
    """Return the safe inputs [B, A] nearest to commands, and where there is any, bool [B].

    Args:
        a_h: [B, A].
        inputs: [B, K, A].
        cost: [B, K]; an input is safe where it costs at most tau_c.
        tau_c: the bound.
    """
    safe = cost <= tau_c
    distance = (inputs - a_h.unsqueeze(1)).norm(dim=-1)
    index = distance.where(safe, torch.inf).argmin(-1)
    nearest = inputs[torch.arange(len(inputs), device=inputs.device), index]
    return nearest, safe.any(-1)
