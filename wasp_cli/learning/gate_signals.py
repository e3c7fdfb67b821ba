"""Which number should gate? Signals of what the operator is about to do, beside the costs and the return that really followed.

Every signal is read at every decision of Human-only episodes from the same nominal rollouts, under the operator who drives and from its
real memory. Dimension letters: B episodes side by side, T decisions of them, M rollouts, H horizon, R = B * M rows of one call to the
model, W window of the target, K judged decisions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from wasp_cli.errors import WaspError
from wasp_cli.learning.configs.latent import GateSignalsConfig
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.learning.critics import train_critics
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.shards import Recording
from wasp_cli.methods.base import Decision
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.noise import DecisionNoise, gumbel, uniform
from wasp_cli.methods.wasp.imagine import Draws, Dynamics, Imagination, Situation
from wasp_cli.methods.wasp.returns import discounted_sum, td_lambda
from wasp_cli.methods.wasp.witness import foreseen
from wasp_cli.models.base import Critics, Latent
from wasp_cli.models.lookahead import LookAhead
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import Operator
from wasp_cli.seeds import derive

NOW, GATE, SUM, FIRST, EXPERT = "now", "gate", "sum", "first", "expert"
"""Signals without a critic; `signals` says what each is. `GATE` is what the safety gate compares with tau_c."""

WINDOWS = (5, 10, 15)
"""Decisions within which the direct look ahead is asked, as far as it looks."""

CriticsByDiscount = Mapping[float, Critics]
"""Critics by the discount of V_c, or of V_r."""


def critic_alone(gamma: float) -> str:
    """Name the signal V(h_t, z_t)."""
    return f"critic@{gamma:g}"


def one_step(gamma: float) -> str:
    """Name Eq. 8 after a single imagined step."""
    return f"step@{gamma:g}"


def discounted(gamma: float) -> str:
    """Name the discounted sum over H steps."""
    return f"discounted@{gamma:g}"


def look_ahead(window: int) -> str:
    """Name the probability of any cost within a window by the direct look ahead."""
    return f"head@{window}"


def bootstrap(gamma: float) -> str:
    """Name Eq. 8 over H steps, with the critic behind them."""
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

    def __init__(
        self,
        model: Dynamics,
        cost_critics: CriticsByDiscount,
        return_critics: CriticsByDiscount,
        expert: Operator,
        config: GateSignalsConfig,
        returns: ReturnsConfig,
        head: LookAhead | None = None,
    ) -> None:
        """Record B episodes.

        Args:
            model: the frozen world model.
            cost_critics: by the discount of V_c; that of `returns.gamma_c` is among them.
            return_critics: by the discount of V_r; that of `returns.gamma_r` is among them.
            expert: unimpaired, of B rows; the nominal operator of one of the signals.
            config: horizon and rollouts.
            returns: lambda, and the gates' own discounts.
            head: the direct look ahead, one more signal of the cost; None leaves it out.

        Raises:
            WaspError: it reads more commands than are imagined.
        """
        if head is not None and head.commands > config.horizon:
            raise WaspError(
                f"the look ahead reads {head.commands} commands, of which gate_signals.horizon imagines {config.horizon}",
                "lower lookahead.commands",
            )
        self.head = head
        self.model, self.cost_critics, self.return_critics = model, cost_critics, return_critics
        self.expert, self.config, self.returns = expert, config, returns
        self.latents = LatentRecorder()
        # Nothing is corrected, so the number of residual steps says nothing.
        gate = WASPConfig(
            horizon=config.horizon, residual_steps=1, gate_rollouts=config.rollouts, bootstrap_reward=True,
            takeover_shares=(), probe_with="random",
        )  # fmt: skip
        self.gate = Imagination(model, self.latents, gate, returns.gamma_r, returns.gamma_c, returns.lam)
        self.noise = DecisionNoise()
        self.seen: list[dict[str, Tensor]] = []
        """Per decision: signals [B] of the cost by name."""
        self.promised: list[dict[str, Tensor]] = []
        """Per decision: signals [B] of the return by name."""

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)
        self.seen, self.promised = [], []

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        generators = self.noise.next()
        size = (self.config.horizon, self.config.rollouts)
        draws = Draws(gumbel(generators, *size, self.model.noise_size), uniform(generators, *size, operator.draws))
        start = Situation(latent, a_h, operator, torch.arange(len(a_h)))
        # The expert first: of the operator's own rollouts the arrived latents are kept.
        expert = self.gate.nominal(start._replace(operator=self.expert), draws).cost
        others = self.latents.arrived
        nothing = a_h.new_zeros(len(a_h), 1, 1, a_h.shape[-1])
        rolled = self.gate.rolled(start, nothing, draws, alone=1, heard=0 if self.head is None else self.head.commands)
        own = rolled.returns.cost.squeeze(1)
        arrived = self.latents.arrived

        gamma_r, gamma_c = self.returns.gamma_r, self.returns.gamma_c
        keep = self.model.continues(arrived)  # [H, R]
        values_c = {gamma: critic.value_c for gamma, critic in self.cost_critics.items()}
        costs = self.signals(self.model.cost, values_c, latent, arrived, keep)
        del costs[discounted(gamma_c)]  # which is the gate's own
        if self.head is not None and rolled.issued is not None:
            ahead = foreseen(self.head, latent, rolled.issued.squeeze(1))
            costs |= {look_ahead(window): ahead[:, window - 1] for window in WINDOWS if window <= self.head.horizon}
        self.seen.append({GATE: own, EXPERT: expert, **costs})
        values_r = {gamma: critic.value_r for gamma, critic in self.return_critics.items()}
        expert_return = self._mean(discounted_sum(self.model.reward(others), gamma_r, self.model.continues(others)))
        self.promised.append({EXPERT: expert_return, **self.signals(self.model.reward, values_r, latent, arrived, keep)})
        return Decision(a_h)

    def signals(
        self,
        read: Callable[[Latent], Tensor],
        values: Mapping[float, Callable[[Latent], Tensor]],
        now: Latent,
        arrived: Latent,
        keep: Tensor,
    ) -> dict[str, Tensor]:
        """Compute signals [B] of the cost, x = c, or of the return, x = r. The gate's own of the cost is sum_k gamma_c^k c-hat_{t+k}.

        In all of them x-hat_{t+k} is read at the arrived state k + 1, and counts with the probability that the episode still goes on.

        - `now`: x-hat(h_t, z_t), what the last decision is believed to have scored.
        - `sum`: sum_k x-hat_{t+k} over H steps, `first`: over the first few of them.
        - `discounted@gamma`: sum_k gamma^k x-hat_{t+k}. Beside it V is all that `bootstrap@gamma` adds.
        - `critic@gamma`: V(h_t, z_t).
        - `step@gamma`: x-hat_t + gamma V(h_{t+1}, z_{t+1}).
        - `bootstrap@gamma`: Eq. 8 as it is written.

        Args:
            read: the model's head of x.
            values: V of x by its discount.
            now: filtered latents [B, .].
            arrived: of the nominal rollouts [H, R, .].
            keep: [H, R] probability that the episode goes on behind them.
        """
        signal = read(arrived)  # [H, R]
        first, lam = self.config.first_steps, self.returns.lam
        found = {
            NOW: read(now),
            SUM: self._mean(discounted_sum(signal, 1.0, keep)),
            FIRST: self._mean(discounted_sum(signal[:first], 1.0, keep[:first])),
        }
        for gamma, critic in values.items():
            value = critic(arrived)
            found[critic_alone(gamma)] = critic(now)
            found[one_step(gamma)] = self._mean(td_lambda(signal[:1], value[:1], gamma, lam, keep[:1]))
            found[bootstrap(gamma)] = self._mean(td_lambda(signal, value, gamma, lam, keep))
            found[discounted(gamma)] = self._mean(discounted_sum(signal, gamma, keep))
        return found

    def _mean(self, rollouts: Tensor) -> Tensor:
        return rollouts.view(-1, self.config.rollouts).mean(-1)


# -- critics ----------------------------------------------------------------------------------------------------


def critics_by_discount(
    model: SafetyWorldModel,
    skills: Skills,
    recording: Recording,
    latents: Latents,
    known: Critics,
    config: GateSignalsConfig,
    returns: ReturnsConfig,
    stream: tuple[str, int],
    report: Callable[[float, str], None],
) -> tuple[dict[float, Critics], dict[float, Critics], dict[str, Any]]:
    """Train critics at every discount of the configuration that neither known critic has.

    Args:
        model: the frozen world model.
        skills: the latent expert among them.
        recording: action, reward, cost, terminal, first and episode of the recorded rows.
        latents: of the same rows.
        known: the trained critics, whose V_r has `returns.gamma_r` and whose V_c `returns.gamma_c`.
        config: the discounts, and the budget of a critic.
        returns: lambda and the known discounts.
        stream: task and seed of the training chain, which name the random streams.
        report: told of the updates.

    Returns:
        Critics by the discount of V_c, by that of V_r, and the curves of those trained here. Both have the known ones among them.
    """
    costs: dict[float, Critics] = {returns.gamma_c: known}
    promises: dict[float, Critics] = {returns.gamma_r: known}
    curves: dict[str, Any] = {}
    missing = [gamma for gamma in config.gammas if not gamma == returns.gamma_c == returns.gamma_r]
    for part, gamma in enumerate(missing):

        def during(share: float, text: str, part: int = part, gamma: float = gamma) -> None:
            report((part + share) / len(missing), f"critics at {gamma:g}, {text}")

        torch.manual_seed(derive("gate-signals-critic-weights", *stream, gamma))
        seed, other = derive("gate-signals-critic", *stream, gamma), returns.model_copy(update={"gamma_c": gamma, "gamma_r": gamma})
        critics, curves[f"{gamma:g}"] = train_critics(model, skills, recording, latents, config.critics, other, seed, during)
        costs.setdefault(gamma, critics)
        promises.setdefault(gamma, critics)
    return dict(sorted(costs.items())), dict(sorted(promises.items())), curves
