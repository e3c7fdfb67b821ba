"""A safety filter that looks one step ahead (after Oh et al. 2025, the human-centred safety
filter): the strongest rule without rollouts.

Q_c(h, z, a) = c-hat(x') + gamma_c V_c(x') over the imagined next state x' = x'(h, z, a). Where the
command keeps it below a threshold, the command stands. Elsewhere the first action below it on the
segment from the command to the safest action is executed, or that action itself where none is. The
original's fallback is a learned policy; here the safest of some actions is sought, since a
bang-bang motor has few. K candidates, P points of the segment, M imagined next states, B episodes,
A actions.
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
from wasp_cli.methods.record import blank_record, chosen
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator

FALLBACK = 0.5  # tau_c where it is to be calibrated and no calibration exists
# purpose of the draws among which the safest action is sought, beside that of the imagined next
# states
CORRECTION = 1
CHUNK = 256  # held-out decisions that are looked at together


class SafetyFilter:
    """See the module."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(FilterConfig, config)
        self.model, self.gamma_c = parts.world_model, parts.gamma_c
        self.critics = load_module(
            LatentCritics, parts.inputs["critics"] / "critics.safetensors"
        ).to(parts.device)
        calibrated = parts.thresholds.get("tau_c", FALLBACK)
        self.tau_c = calibrated if self.config.tau_c == "calibrated" else float(self.config.tau_c)
        self.noise = DecisionNoise(parts.device)

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        streams = self.noise.streams()
        draws = self._draws(streams)
        now = self.q_c(latent, a_h.unsqueeze(1), draws).squeeze(1)  # [B]
        over = now > self.tau_c
        rows = chosen(over)
        action, record = a_h.clone(), blank_record(len(a_h), device=a_h.device)
        if len(rows):
            (uniforms,) = streams.uniform(
                (self.config.candidates, a_h.shape[1]), purpose=CORRECTION, rows=rows
            )
            corrected = self._corrected(latent.rows(rows), a_h[rows], draws[rows], uniforms)
            action[rows] = torch.where(over[rows].unsqueeze(-1), corrected, a_h[rows])
            record = record._replace(gate=(GATE_METHOD * over).to(torch.int8))
        return Decision(action, record._replace(signal=now))

    def q_c(self, latent: Latent, actions: Tensor, draws: Tensor) -> Tensor:
        """Return Q_c [B, K]: discounted costly decision steps of executing actions [B, K, A] once,
        and the nominal expert's behind them.

        Args:
            latent: [B, .]
            actions: [B, K, A] within the bounds.
            draws: Gumbel [B, M, Z], shared by the K actions of a row (common random numbers).
        """
        batch, several, size = actions.shape
        rollouts = draws.shape[1]
        copies = several * rollouts
        action = actions.unsqueeze(2).expand(-1, -1, rollouts, -1).reshape(batch * copies, size)
        noise = draws.unsqueeze(1).expand(-1, several, -1, -1).reshape(batch * copies, -1)
        arrived = self.model.imagine(latent.expand_rows(copies), action, noise)
        keep = self.model.continues(arrived)  # nothing costs behind the end of an episode
        found = self.model.cost(arrived) + self.gamma_c * keep * self.critics.value_c(arrived)
        return found.view(batch, several, rollouts).mean(-1)

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set tau_c to a quantile of Q_c [N] under the expert, over decisions without cost
        after them; return it with the distributions.
        """
        total = len(heldout.a_h)
        self.reset(torch.ones(total, dtype=torch.bool), [seed + i for i in range(total)])
        draws = self._draws(self.noise.streams())
        chunks = torch.arange(total, device=draws.device).split(CHUNK)
        found = torch.cat(
            [
                self.q_c(heldout.latent.rows(c), heldout.a_h[c].unsqueeze(1), draws[c]).squeeze(1)
                for c in chunks
            ]
        )
        free = found[cost_ahead == 0]
        if self.config.tau_c == "calibrated":
            self.tau_c = (
                float(torch.quantile(free, self.config.quantile)) if len(free) else FALLBACK
            )
        spread = {
            f"{name}_{label}": float(torch.quantile(values, q)) if len(values) else float("nan")
            for name, values in (("q_c", found), ("q_c_free", free))
            for label, q in (("median", 0.5), ("p90", 0.90), ("p95", 0.95))
        }
        return {
            "tau_c": self.tau_c,
            **spread,
            "expert_rate": float((found > self.tau_c).float().mean()),
        }

    def _corrected(self, latent: Latent, a_h: Tensor, draws: Tensor, uniforms: Tensor) -> Tensor:
        """Return the least correction [B, A] along the segment from a_h to the safest candidate."""
        batch, actions = a_h.shape
        # Where motors saturate, as far as there are no more corners than candidates; and a stop.
        corners = (
            product((-1.0, 1.0), repeat=actions) if 2**actions <= self.config.candidates else ()
        )
        known = torch.tensor([*corners, [0.0] * actions], device=a_h.device)
        candidates = torch.cat([known.expand(batch, -1, -1), 2 * uniforms - 1], 1)
        # [B, 1, A]
        safest = candidates[
            torch.arange(batch, device=a_h.device), self.q_c(latent, candidates, draws).argmin(1)
        ].unsqueeze(1)
        share = (
            torch.arange(1, self.config.segment + 1, device=a_h.device).view(1, -1, 1)
            / self.config.segment
        )
        # [B, P, A], the last is the safest action
        points = torch.lerp(a_h.unsqueeze(1), safest, share)
        good = self.q_c(latent, points, draws) <= self.tau_c
        good[:, -1] = True
        first = good.to(torch.int8).argmax(1)  # argmax gives the first of equal values
        return points[torch.arange(batch, device=a_h.device), first]

    def _draws(self, streams: Streams) -> Tensor:
        return as_gumbel(streams.uniform((self.config.rollouts, self.model.noise_size))[0])
