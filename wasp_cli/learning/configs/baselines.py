"""Sections of what IDA, Diffusion and SafeRL-Res learn."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from wasp_cli.config import Config, assumed, deviates, from_paper
from wasp_cli.learning.configs.shared import LADDER, Layers


class EnsembleConfig(Config):
    """IDA's Q ensemble for the expert, TD on real and noisy transitions."""

    members: int = assumed(5, "ensemble size, as in TS2C", ge=1)
    hidden: Layers = assumed((256, 256), "layers of a member")
    updates: int = assumed(4000, "gradient steps", ge=1)
    batch: int = assumed(256, "transitions per update", ge=1)
    learning_rate: float = assumed(3e-4, "Adam", gt=0.0)
    target_rate: float = assumed(
        0.05,
        "share of the online network that enters the target per update: a reward travels "
        "back one decision in 1 / rate updates",
        gt=0.0,
        le=1.0,
    )


class DenoiserConfig(Config):
    """Diffusion's action denoiser, conditioned on the latent features."""

    steps: int = assumed(50, "T: diffusion steps of the original", ge=2)
    beta_min: float = assumed(1e-4, "first beta of the sigmoid schedule", gt=0.0, lt=1.0)
    beta_max: float = assumed(0.26, "last beta of the sigmoid schedule", gt=0.0, lt=1.0)
    hidden: Layers = assumed((128, 128, 128), "layers")
    updates: int = assumed(8000, "gradient steps (the original has 30,000)", ge=1)
    batch: int = assumed(512, "transitions per update (the original has 4096)", ge=1)
    learning_rate: float = assumed(1e-3, "Adam", gt=0.0)
    ema: float = assumed(0.999, "decay of the averaged weights that are used", ge=0.0, lt=1.0)


class ResidualConfig(Config):
    """SafeRL-Res: PPO with a Lagrange multiplier over (h, z, a^H) in the real task."""

    mode: Literal["lagrangian", "rsa"] = from_paper(
        "lagrangian", "Eq. 5; `rsa`: the least effort for a least return, the form of the original"
    )
    return_share: float = assumed(
        0.75,
        "mode rsa: the least return, as a share of the unimpaired expert's; the original "
        "tunes it per pilot",
        gt=0.0,
    )
    interactions: int = assumed(300_000, "decision steps (the original has 100 M)", ge=1)
    envs: int = assumed(16, "episodes side by side", ge=1)
    rollout: int = assumed(128, "decision steps per environment and update", ge=1)
    epochs: int = assumed(4, "passes over a rollout", ge=1)
    batch: int = assumed(256, "minibatch", ge=2)
    learning_rate: float = assumed(3e-4, "Adam", gt=0.0)
    gamma: float = assumed(0.98, "discount per decision step", gt=0.0, le=1.0)
    hidden: Layers = assumed((128, 128), "layers of actor and value network")
    entropy: float = assumed(0.0, "entropy bonus", ge=0.0)
    log_std_init: float = assumed(
        -0.4,
        "initial exploration of the residual; motors saturate, so that a small residual to a full "
        "command changes nothing",
    )
    alpha: float = assumed(0.1, "Eq. 5: weight of the squared residual", ge=0.0)
    cost_limit: Annotated[float, Field(ge=0.0)] | Literal["auto"] = deviates(
        25.0,
        "kappa per 1000 env steps, without a discount, as the benchmark counts; Eq. 5 "
        "bounds the discounted cost; `auto`: that of the expert, which is the default on tasks "
        "of one's own",
    )
    value_warmup: float = assumed(
        0.02, "share of the interactions that train only the value function", ge=0.0, lt=1.0
    )
    multiplier_delay: float = assumed(
        0.05, "share of the interactions before the multiplier moves", ge=0.0, lt=1.0
    )
    multiplier_init: float = assumed(
        1.0, "penalty per costly decision step; in mode rsa the weight of the return", ge=0.0
    )
    multiplier_lr: float = assumed(
        0.1, "step of the multiplier per update and unit of relative excess", ge=0.0
    )
    multiplier_max: float = assumed(5.0, "upper bound of the multiplier", gt=0.0)
    operators: dict[str, tuple[float, ...]] = assumed(
        LADDER, "operators mixed per episode", min_length=1
    )
