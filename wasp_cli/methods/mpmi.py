"""MPMI: many inputs are imagined at once, and of those that are safe the one nearest to the command
is executed.

After Broad, Murphey and Argall (RSS 2019, arXiv:1906.02318; code: asbroad/mpmi_shared_control).
There is no task gate, no search and no learned value: what it does not reach is what these add. As
in the authors' code

- an input is held over the whole horizon, by whoever is at the controls;
- inputs lie evenly over the bounds, the same ones at every decision;
- where no input is safe, the command stands: they call it a failure of the system, and leave it to
  the operator;
- an input is executed as it was imagined. A motor that saturates makes others of them the same
  force, of which nothing is made.

The horizon is five decisions, .4 s on Goal1 and .8 s on the cars; theirs is .3 and .4 s. Over the
fifteen of WASP an expert's held input leaves the road, tau_c says little, and commands are replaced
too late.

What differs: the model is the latent world model in place of a Koopman operator; safe is what the
safety gate of WASP means by it (costly decisions within H, discounted, a mean over rollouts on
common draws), where theirs is a distance to the edge on one trajectory; the command is one of the
inputs, so that it stands where it is safe (theirs is moved to the grid, which is a hundredth wide);
and the distance is Euclidean, where their code for the race car has fourth powers of gas and brake.

tau_c is calibrated as that of the safety filter. WASP's number does not fit: an expert who keeps
holding an input costs more than one who goes on steering. B episodes, K inputs, M rollouts, H
horizon, A actions, N held-out decisions.
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
from wasp_cli.methods.record import blank_record, chosen
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Situation, over_rollouts
from wasp_cli.methods.wasp.returns import discounted_sum, distributions, quantile
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Critics, Latent
from wasp_cli.operators.base import DrawnNoise, Operator

FALLBACK = 0.5  # tau_c where it is to be calibrated and no calibration exists
CHUNK = 64  # held-out decisions that are looked at together


class MPMI:
    """See the module."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(MPMIConfig, config)
        no_critics = cast(Critics, None)  # nothing is valued behind the horizon
        model = parts.world_model
        self.imagination = Imagination(
            model, no_critics, parts.skills.expert, parts.gamma_r, parts.gamma_c, parts.lam
        )
        calibrated = parts.thresholds.get("tau_c", FALLBACK)
        self.tau_c = calibrated if self.config.tau_c == "calibrated" else float(self.config.tau_c)
        self.noise = DecisionNoise(parts.device)
        # A Sobol sequence lies as evenly as a grid, for any number of inputs and actions; the
        # second of them is a stop.
        # [K, A]
        self.inputs = (
            2
            * torch.quasirandom.SobolEngine(model.action_size)
            .draw(self.config.candidates)
            .to(parts.device)
            - 1
        )

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        draws = self._draws(self.noise.streams())
        now = self.g_c(latent, a_h.unsqueeze(1), draws).squeeze(1)  # [B]
        unsafe = now > self.tau_c
        rows = chosen(unsafe)
        action, record = a_h.clone(), blank_record(len(a_h), device=a_h.device)
        if len(rows):
            inputs = self.inputs.expand(len(rows), -1, -1)
            found, safe = nearest_safe(
                a_h[rows], inputs, self.g_c(latent.rows(rows), inputs, draws.rows(rows)), self.tau_c
            )
            replaced = unsafe[rows] & safe
            action[rows] = torch.where(replaced.unsqueeze(-1), found, a_h[rows])
            record.gate[rows] = (GATE_METHOD * replaced).to(torch.int8)
        return Decision(action, record._replace(signal=now))

    def g_c(self, latent: Latent, inputs: Tensor, draws: Draws) -> Tensor:
        """Return the costly decisions [B, K] within H, discounted, of holding inputs [B, K, A] from
        latent states [B, .] on.

        Args:
            latent: [B, .]
            inputs: [B, K, A] within the bounds.
            draws: of M rollouts, met by every input (common random numbers).
        """
        batch, _, size = inputs.shape
        held = over_rollouts(inputs.unsqueeze(2), self.config.rollouts).squeeze(1)  # [R, A]
        holding = Operator(lambda features: held, size, DrawnNoise(held.new_zeros(0, 1, 0)), batch)
        start = Situation(latent, inputs[:, 0], holding, torch.arange(batch, device=inputs.device))
        imagined = self.imagination.roll(start, inputs.shape[1], lambda k, command: held, draws)
        return discounted_sum(imagined.cost(), self.imagination.gamma_c, imagined.continues()).mean(
            -1
        )

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set tau_c to a quantile of G_c [N] under the expert, over decisions without cost
        after them; return it with the distributions.
        """
        total = len(heldout.a_h)
        self.reset(torch.ones(total, dtype=torch.bool), [seed + i for i in range(total)])
        draws = self._draws(self.noise.streams())
        chunks = torch.arange(total, device=heldout.a_h.device).split(CHUNK)
        looks = [
            self.g_c(heldout.latent.rows(chunk), heldout.a_h[chunk].unsqueeze(1), draws.rows(chunk))
            for chunk in chunks
        ]
        cost = torch.cat(looks).squeeze(1)
        free = cost[cost_ahead == 0]
        if self.config.tau_c == "calibrated":
            self.tau_c = quantile(free, self.config.quantile) if len(free) else FALLBACK
        rate = float((cost > self.tau_c).float().mean())
        return {
            "tau_c": self.tau_c,
            **distributions(g_cost=cost, g_cost_free=free),
            "expert_rate": rate,
        }

    def _draws(self, streams: Streams) -> Draws:
        (uniforms,) = streams.uniform(
            (self.config.horizon, self.config.rollouts, self.imagination.model.noise_size)
        )
        return Draws(as_gumbel(uniforms), uniforms.new_zeros(*uniforms.shape[:3], 0))


def nearest_safe(a_h: Tensor, inputs: Tensor, cost: Tensor, tau_c: float) -> tuple[Tensor, Tensor]:
    """Return the nearest [B, A] to commands a_h [B, A] of those inputs [B, K, A] that cost [B,
    K] at most tau_c; and where one does [B].
    """
    safe = cost <= tau_c
    distance = (inputs - a_h.unsqueeze(1)).norm(dim=-1)
    index = distance.where(safe, torch.inf).argmin(-1)
    return inputs[torch.arange(len(inputs), device=inputs.device), index], safe.any(-1)
