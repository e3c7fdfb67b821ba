"""Episodes in the worlds of `scene_worlds`: a driver alone or with WASP, and what is imagined on
the way.

Dimension letters: B rows, A action size, T decision steps, K imagined rollouts, H horizon, L
residual steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scene_worlds import PointWorld
from torch import Tensor

from wasp_cli.methods.base import Assistant
from wasp_cli.methods.configs import PrintedConfig
from wasp_cli.methods.human import HumanOnly
from wasp_cli.methods.noise import gumbel, uniform
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.methods.wasp.printed import Printed
from wasp_cli.metrics.episode import GATE_NONE, INTERVENED
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import DrawnNoise, Operator

Array = NDArray[Any]

GAMMA_R, GAMMA_C, LAM = 0.99, 0.95, 1.0
"""Where critics expect nothing, lambda is 1: Eq. 8 is then the discounted sum over the horizon."""

TAU_C, TAU_R = 0.3, 0.5
"""Thresholds of the gates: 0.3 costly steps within the horizon, and a gain of 5 cm of way."""


def settings(variant: str = "full", **changes: object) -> PrintedConfig:
    """WASP as printed in these scenes: its defaults but for what belongs to a world:
    thresholds, size and weight of residuals.
    """
    world = {"tau_c": TAU_C, "tau_r": TAU_R, "alpha": 0.02, "initial_std": 1.0}
    return PrintedConfig.model_validate({"variant": variant, "rollouts": 1, **world, **changes})


class NoCritics:
    """Nothing beyond the horizon."""

    def value_r(self, latent: Latent) -> Tensor:
        """Return zeros [...]."""
        return torch.zeros_like(latent.h[..., 0])

    value_c = value_r


def imagination(world: PointWorld) -> Imagination:
    """Imagined returns in a world that is known exactly."""
    return Imagination(
        world,
        NoCritics(),
        lambda features: features.new_zeros(len(features), world.action_size),
        GAMMA_R,
        GAMMA_C,
        LAM,
    )


def assistant(world: PointWorld, config: PrintedConfig | None) -> Assistant:
    """WASP as printed over a world that it knows; Human-only without a configuration."""
    return HumanOnly() if config is None else Printed(config, imagination(world), {})


class Drive(NamedTuple):
    """What B episodes left behind. After an episode's end only rows of `alive` count."""

    state: Array
    """[T + 1, B, 2A] places and velocities, from the start on"""
    a_h: Array
    """[T, B, A] the driver's commands"""
    action: Array
    """[T, B, A] what was executed"""
    reward: Array
    """[T, B]"""
    cost: Array
    """[T, B] in {0, 1}"""
    gate: Array
    """[T, B] one of GATE_*"""
    g_cost: Array
    """[T, B] nominal cost return (Eq. 9); NaN without a gate"""
    delta_g: Array
    """[T, B] gain of the task gate's probe (Eq. 12); NaN where it was not asked"""
    plan: Array
    """[T, B, L, A] chosen residuals; NaN where nothing was planned"""
    case2: Array
    """[T, B] share of Case II among the planner's iterations; 0 where nothing was planned"""
    alive: Array
    """[T, B]"""

    @property
    def intervened(self) -> Array:
        """[T, B] whether the executed action differs from the command."""
        return self.alive & (np.linalg.norm(self.action - self.a_h, axis=-1) > INTERVENED)

    @property
    def arrived(self) -> Array:
        """[B] whether the goal was reached; the last step counts as not."""
        return ~self.alive[-1]

    @property
    def length(self) -> Array:
        """[B] decision steps of each episode."""
        return self.alive.sum(0)

    @property
    def costs(self) -> Array:
        """[B] steps in the hazard."""
        return (self.cost * self.alive).sum(0)

    @property
    def returns(self) -> Array:
        """[B] sum of rewards."""
        return (self.reward * self.alive).sum(0)

    @property
    def int_rate(self) -> float:
        """Share of all decision steps with an intervention."""
        return float(self.intervened.sum() / self.alive.sum())


Watch = Callable[[Latent, Tensor, Operator], None]
"""Called before every decision with the latents, the commands [B, A] just issued and the
operator that issued them.
"""


@torch.inference_mode()
def drive(
    world: PointWorld,
    operator: Operator,
    config: PrintedConfig | None,
    steps: int,
    *,
    start: Latent | None = None,
    seed: int = 0,
    watch: Watch | None = None,
) -> Drive:
    """The closed loop in a world that is its own truth, for all rows of an operator side by side.

    Args:
        world: steps the truth, and is what the assistant imagines with.
        operator: of B rows, fresh.
        config: of WASP; None executes the driver's commands.
        steps: T.
        start: [B]; the world's own start if None.
        seed: names the streams of the world's noise and of the assistant.
        watch: sees every decision's situation.
    """
    batch = operator.batch
    latent = world.initial(batch) if start is None else start
    helper = assistant(world, config)
    helper.reset(torch.ones(batch, dtype=torch.bool), [1000 * seed + row for row in range(batch)])
    truth = [np.random.default_rng((seed, row)) for row in range(batch)]
    alive = torch.ones(batch, dtype=torch.bool)
    undefined = torch.full((batch,), torch.nan)
    blank = (
        torch.full((batch,), GATE_NONE),
        undefined,
        undefined,
        undefined.view(-1, 1, 1),
        torch.zeros(batch),
    )
    states, found = [latent.h], []
    for _ in range(steps):
        a_h = operator.command(latent.features).clamp(-1, 1)
        if watch is not None:
            watch(latent, a_h, operator)
        action, record, planned = helper.decide(latent, a_h, operator)
        latent = world.imagine(latent, action, gumbel(truth, world.noise_size))
        gates = blank[:3] if record is None else (record.gate, record.g_cost, record.delta_g)
        plans = (
            blank[3:]
            if planned is None
            else (planned.residuals, planned.case2.to(torch.float32).mean(-1))
        )
        found.append(
            (a_h, action, world.reward(latent), world.inside(latent), *gates, *plans, alive)
        )
        alive = alive & (world.continues(latent) > 0)
        states.append(latent.h)
    return Drive(
        torch.stack(states).numpy(),
        *(torch.stack(column).numpy() for column in zip(*found, strict=True)),
    )


@torch.inference_mode()
def imagined(
    world: PointWorld,
    operator: Operator,
    latent: Latent,
    a_h: Tensor,
    horizon: int,
    copies: int,
    *,
    plan: Tensor | None = None,
    seed: int = 0,
) -> Array:
    """K imagined rollouts from one row, of the driver alone as the safety gate sees them, or of a
    plan and him (Eq. 13).

    Args:
        world: what is imagined.
        operator: has just issued `a_h`; its copies begin with its memory.
        latent: one row.
        a_h: [1, A]
        horizon: H.
        copies: K.
        plan: residuals [L, A].
        seed: names the draws.

    Returns:
        States [H + 1, K, 2A].
    """
    source = [np.random.default_rng(seed)]
    gusts = gumbel(source, horizon, copies, world.noise_size)[0]  # [H, K, Z]
    forked = operator.fork(
        torch.zeros(1, dtype=torch.long),
        copies,
        DrawnNoise(uniform(source, horizon, copies, operator.draws)[0]),
    )
    latent, now = latent.expand_rows(copies), a_h.repeat_interleave(copies, 0)
    states = [latent.h]
    for k in range(horizon):
        action = now if k == 0 else forked.command(latent.features)
        if plan is not None and k < len(plan):
            action = (now + plan[k]).clamp(-1, 1)
        latent = world.imagine(latent, action, gusts[k])
        states.append(latent.h)
    return torch.stack(states).numpy()
