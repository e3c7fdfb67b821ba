"""Which number should gate? Signals of what the operator is about to do, beside the costs that really followed.

Every signal is read at every decision of Human-only episodes from the same nominal rollouts, under the operator who drives and from its
real memory. Dimension letters: B episodes side by side, T decisions of them, M rollouts, H horizon, R = B * M rows of one call to the
model, W window of the target, K judged decisions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.learning.closed_loop import Loop
from wasp_cli.learning.configs import GateSignalsConfig, ReturnsConfig
from wasp_cli.learning.critics import train_critics
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.shards import Replay
from wasp_cli.methods.base import Decision
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.noise import DecisionNoise, gumbel, uniform
from wasp_cli.methods.wasp.imagine import Draws, Dynamics, Imagination, Situation
from wasp_cli.methods.wasp.returns import discounted_sum, td_lambda
from wasp_cli.metrics.windows import sums_ahead
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
    """Name of the signal V_c(h_t, z_t)."""
    return f"critic@{gamma:g}"


def one_step(gamma: float) -> str:
    """Name of Eq. 8 after a single imagined step."""
    return f"step@{gamma:g}"


def discounted(gamma: float) -> str:
    """Name of the discounted sum over H steps, as the gate has it, at another discount than the gate's."""
    return f"discounted@{gamma:g}"


def bootstrap(gamma: float) -> str:
    """Name of Eq. 8 over H steps with V_c."""
    return f"bootstrap@{gamma:g}"


# -- while the operator drives ----------------------------------------------------------------------------------


class Onlooker:
    """Critics that are worth nothing and keep the arrived latents which an imagination shows them."""

    def __init__(self) -> None:
        self.arrived = Latent(torch.zeros(0), torch.zeros(0))
        """[H, R, .] of the last rollouts"""

    def value_r(self, latent: Latent) -> Tensor:
        self.arrived = latent
        return torch.zeros_like(latent.h[..., 0])

    def value_c(self, latent: Latent) -> Tensor:
        return self.value_r(latent)


class Watcher:
    """An assistant that executes every command as it is, and keeps what a gate could have looked at."""

    def __init__(self, model: Dynamics, critics: CostCritics, expert: Operator, config: GateSignalsConfig, returns: ReturnsConfig) -> None:
        """A watcher of B episodes.

        Args:
            model: the frozen world model.
            critics: V_c by gamma_c; that of `returns.gamma_c` is among them.
            expert: unimpaired, of B rows; the nominal operator of one of the signals.
            config: horizon and rollouts.
            returns: lambda, and the gate's own gamma_c.
        """
        self.model, self.critics, self.expert, self.config, self.returns = model, critics, expert, config, returns
        self.onlooker = Onlooker()
        # Nothing is corrected, so the number of residual steps says nothing.
        gate = WASPConfig(horizon=config.horizon, residual_steps=1, gate_rollouts=config.rollouts)
        self.gate = Imagination(model, self.onlooker, gate, returns.gamma_r, returns.gamma_c, returns.lam)
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
        # The expert first: of the operator's own rollouts the onlooker keeps the arrived latents.
        expert = self.gate.nominal(start._replace(operator=self.expert), draws).cost
        own = self.gate.nominal(start, draws).cost
        self.seen.append({GATE: own, EXPERT: expert, **self.signals(latent, self.onlooker.arrived)})
        return Decision(a_h)

    def signals(self, now: Latent, arrived: Latent) -> dict[str, Tensor]:
        """The signals [B] beside the gate's own, which is sum_k gamma_c^k c-hat_{t+k}.

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


# -- what followed ----------------------------------------------------------------------------------------------


class Watched(NamedTuple):
    """K decisions whose next W are known, with what was signalled at them."""

    signals: dict[str, Floats]
    """[K] by name"""
    before: NDArray[np.bool_]
    """[K] the decision before cost: there is nothing to foresee any more"""
    ahead: Floats
    """[K] costly decisions among the W that begin with this one"""
    discounted: Floats
    """[K] sum_k gamma_c^k c_{t+k} over them"""
    episode: NDArray[np.int64]
    """[K]"""


def watched(loop: Loop, seen: Sequence[Mapping[str, Tensor]], window: int, gamma: float, first: int = 0) -> Watched:
    """The decisions of B episodes beside the costs that followed.

    Those after which a time limit cuts the window off are left out. Where an episode ended by the task's own rule nothing follows, and its
    last decisions count.

    Args:
        loop: the recorded episodes.
        seen: [T] signals [B] by name.
        window: W.
        gamma: of the discounted sum.
        first: number of the first episode.
    """
    columns = {name: torch.stack([row[name] for row in seen]).double().numpy() for name in seen[0]}  # [T, B]
    parts = [_episode(loop, columns, row, window, gamma, first + row) for row in range(loop.alive.shape[1])]
    return joined(parts)


def joined(parts: Sequence[Watched]) -> Watched:
    """The decisions of all parts, one part after the other."""
    signals = {name: np.concatenate([part.signals[name] for part in parts]) for name in parts[0].signals}
    return Watched(signals, *(np.concatenate(fields) for fields in zip(*(part[1:] for part in parts), strict=True)))


def _episode(loop: Loop, columns: Mapping[str, Floats], row: int, window: int, gamma: float, number: int) -> Watched:
    length = int(loop.alive[:, row].sum())
    cost = loop.cost[:length, row].astype(np.float64)
    after = np.zeros(window - 1 if loop.terminated[:length, row].any() else 0)
    padded = np.concatenate([cost, after])
    ahead = sums_ahead(padded, np.zeros(len(padded)), window)[:length]
    known = np.flatnonzero(~np.isnan(ahead))
    # `convolve` runs its kernel backwards; entry t is the sum over the window that begins at t.
    discounted = np.convolve(padded, gamma ** np.arange(window)[::-1], "valid") if len(known) else np.zeros(0)
    before = np.concatenate([[False], cost[:-1] > 0])[known]
    signals = {name: column[known, row] for name, column in columns.items()}
    return Watched(signals, before, ahead[known], discounted[known], np.full(len(known), number))


# -- critics ----------------------------------------------------------------------------------------------------


def cost_critics(
    model: SafetyWorldModel,
    skills: Skills,
    replay: Replay,
    latents: Latents,
    known: Critics,
    config: GateSignalsConfig,
    returns: ReturnsConfig,
    stream: tuple[str, int],
    report: Callable[[float, str], None],
) -> tuple[dict[float, Critics], dict[str, Any]]:
    """V_c at every discount of the configuration, and the curves of those trained here.

    Args:
        model: the frozen world model.
        skills: the latent expert among them.
        replay: terminal, cost and episode of the recorded rows.
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
        found[gamma], curves[f"{gamma:g}"] = train_critics(model, skills, replay, latents, config.critics, other, seed, during)
    return dict(sorted(found.items())), curves
