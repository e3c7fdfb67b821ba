"""Which number should gate? Signals of what the operator is about to do, beside the costs that really followed.

Every signal is read at every decision of Human-only episodes from the same nominal rollouts, under the operator who drives and from its
real memory. Dimension letters: B episodes side by side, T decisions of them, M rollouts, H horizon, R = B * M rows of one call to the
model, W window of the target, K judged decisions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.learning.configs import GateSignalsConfig, ReturnsConfig
from wasp_cli.learning.critics import train_critics
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.shards import Recording
from wasp_cli.methods.base import Decision
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.noise import DecisionNoise, gumbel, uniform
from wasp_cli.methods.wasp.imagine import Draws, Dynamics, Imagination, Situation
from wasp_cli.methods.wasp.returns import discounted_sum, td_lambda
from wasp_cli.models.base import Critics, Latent
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import Operator
from wasp_cli.seeds import derive

NOW, GATE, SUM, FIRST, EXPERT = "now", "gate", "sum", "first", "expert"
"""Signals without a critic; `signals` says what each is. `GATE` is what the safety gate compares with tau_c."""

Floats = NDArray[np.float64]
CostCritics = Mapping[float, Critics]
"""V_c by its gamma_c."""


def critic_alone(gamma: float) -> str:
    """Name the signal V_c(h_t, z_t)."""
    return f"critic@{gamma:g}"


def one_step(gamma: float) -> str:
    """Name Eq. 8 after a single imagined step."""
    return f"step@{gamma:g}"


def discounted(gamma: float) -> str:
    """Name the discounted sum over H steps, as the gate has it, at another discount than the gate's."""
    return f"discounted@{gamma:g}"


def bootstrap(gamma: float) -> str:
    """Name Eq. 8 over H steps with V_c."""
    return f"bootstrap@{gamma:g}"


# -- while the operator drives ----------------------------------------------------------------------------------


class LatentRecorder:
    """Critics of value zero that record the arrived latents of an imagination."""

    def __init__(self) -> None:
        self.arrived = Latent(torch.zeros(0), torch.zeros(0))
        """[H, R, .] of the last rollouts"""

    def value_r(self, latent: Latent) -> Tensor:
        self.arrived = latent
        return torch.zeros_like(latent.h[..., 0])

    def value_c(self, latent: Latent) -> Tensor:
        return self.value_r(latent)


class SignalRecorder:
    """An assistant that executes every command as it is, and records what a gate could have looked at."""

    def __init__(self, model: Dynamics, critics: CostCritics, expert: Operator, config: GateSignalsConfig, returns: ReturnsConfig) -> None:
        """Record B episodes.

        Args:
            model: the frozen world model.
            critics: V_c by gamma_c; that of `returns.gamma_c` is among them.
            expert: unimpaired, of B rows; the nominal operator of one of the signals.
            config: horizon and rollouts.
            returns: lambda, and the gate's own gamma_c.
        """
        self.model, self.critics, self.expert, self.config, self.returns = model, critics, expert, config, returns
        self.latents = LatentRecorder()
        # Nothing is corrected, so the number of residual steps says nothing.
        gate = WASPConfig(
            horizon=config.horizon, residual_steps=1, gate_rollouts=config.rollouts, bootstrap_reward=True,
            takeover_shares=(), probe_with="random",
        )  # fmt: skip
        self.gate = Imagination(model, self.latents, gate, returns.gamma_r, returns.gamma_c, returns.lam)
        self.noise = DecisionNoise()
        self.seen: list[dict[str, Tensor]] = []
        """Per decision: signals [B] by name."""

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)
        self.seen = []

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        generators = self.noise.next()
        size = (self.config.horizon, self.config.rollouts)
        draws = Draws(gumbel(generators, *size, self.model.noise_size), uniform(generators, *size, operator.draws))
        start = Situation(latent, a_h, operator, torch.arange(len(a_h)))
        # The expert first: of the operator's own rollouts the arrived latents are kept.
        expert = self.gate.nominal(start._replace(operator=self.expert), draws).cost
        own = self.gate.nominal(start, draws).cost
        self.seen.append({GATE: own, EXPERT: expert, **self.signals(latent, self.latents.arrived)})
        return Decision(a_h)

    def signals(self, now: Latent, arrived: Latent) -> dict[str, Tensor]:
        """Compute the signals [B] beside the gate's own, which is sum_k gamma_c^k c-hat_{t+k}.

        In all of them c-hat_{t+k} is read at the arrived state k + 1, and counts with the probability that the episode still goes on.

        - `now`: c-hat(h_t, z_t), the cost that the last decision is believed to have had.
        - `sum`: sum_k c-hat_{t+k} over H steps, `first`: over the first few of them.
        - `discounted@gamma`: sum_k gamma^k c-hat_{t+k}. Beside it V_c is all that `bootstrap@gamma` adds.
        - `critic@gamma`: V_c(h_t, z_t).
        - `step@gamma`: c-hat_t + gamma V_c(h_{t+1}, z_{t+1}).
        - `bootstrap@gamma`: Eq. 8 as it is written.

        Args:
            now: filtered latents [B, .].
            arrived: of the nominal rollouts [H, R, .].
        """
        cost, keep = self.model.cost(arrived), self.model.continues(arrived)  # [H, R]
        first, lam = self.config.first_steps, self.returns.lam

        def mean(rollouts: Tensor) -> Tensor:
            return rollouts.view(-1, self.config.rollouts).mean(-1)

        found = {
            NOW: self.model.cost(now),
            SUM: mean(discounted_sum(cost, 1.0, keep)),
            FIRST: mean(discounted_sum(cost[:first], 1.0, keep[:first])),
        }
        for gamma, critic in self.critics.items():
            value = critic.value_c(arrived)
            found[critic_alone(gamma)] = critic.value_c(now)
            found[one_step(gamma)] = mean(td_lambda(cost[:1], value[:1], gamma, lam, keep[:1]))
            found[bootstrap(gamma)] = mean(td_lambda(cost, value, gamma, lam, keep))
            if gamma != self.returns.gamma_c:
                found[discounted(gamma)] = mean(discounted_sum(cost, gamma, keep))
        return found


# -- critics ----------------------------------------------------------------------------------------------------


def cost_critics(
    model: SafetyWorldModel,
    skills: Skills,
    recording: Recording,
    latents: Latents,
    known: Critics,
    config: GateSignalsConfig,
    returns: ReturnsConfig,
    stream: tuple[str, int],
    report: Callable[[float, str], None],
) -> tuple[dict[float, Critics], dict[str, Any]]:
    """Train V_c at every further discount of the configuration; return all of them, and the curves of those trained here.

    Args:
        model: the frozen world model.
        skills: the latent expert among them.
        recording: terminal, cost and episode of the recorded rows.
        latents: of the same rows.
        known: the trained critics, whose V_c has `returns.gamma_c`.
        config: the discounts, and the budget of a critic.
        returns: lambda and the other discounts.
        stream: task and seed of the training chain, which name the random streams.
        report: told of the updates.
    """
    found: dict[float, Critics] = {returns.gamma_c: known}
    curves: dict[str, Any] = {}
    missing = [gamma for gamma in config.gammas if gamma != returns.gamma_c]
    for part, gamma in enumerate(missing):

        def during(share: float, text: str, part: int = part, gamma: float = gamma) -> None:
            report((part + share) / len(missing), f"V_c at {gamma:g}, {text}")

        torch.manual_seed(derive("gate-signals-critic-weights", *stream, gamma))
        seed, other = derive("gate-signals-critic", *stream, gamma), returns.model_copy(update={"gamma_c": gamma})
        found[gamma], curves[f"{gamma:g}"] = train_critics(model, skills, recording, latents, config.critics, other, seed, during)
    return dict(sorted(found.items())), curves
