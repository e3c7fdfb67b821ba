"""Sections of the privileged expert and of the dataset that it and others drive."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from wasp_cli.config import Config, assumed
from wasp_cli.learning.configs.shared import Layers


class Bars(Config):
    """What an expert has to reach on fresh layouts, in means over episodes."""

    least_return: float | None = assumed(None, "return")
    least_success: float | None = assumed(None, "share of successful episodes", ge=0.0, le=1.0)
    most_cost: float | None = assumed(None, "env steps that cost", ge=0.0)

    def reached(self, return_: float, success: float, cost: float) -> bool:
        """Return whether means over episodes reach all bars that are set."""
        return (
            (self.least_return is None or return_ >= self.least_return)
            and (self.least_success is None or success >= self.least_success)
            and (self.most_cost is None or cost <= self.most_cost)
        )


class ExpertConfig(Config):
    """PPO with an adaptive Lagrange multiplier on privileged observations, until its task's
    bars are reached.
    """

    interactions: int = assumed(400_000, "decision steps", ge=1)
    envs: int = assumed(32, "episodes side by side", ge=1)
    rollout: int = assumed(64, "decision steps per environment and update", ge=1)
    epochs: int = assumed(8, "passes over a rollout", ge=1)
    batch: int = assumed(1024, "minibatch", ge=2)
    learning_rate: float = assumed(4e-4, "decays linearly to a tenth", gt=0.0)
    gamma: float = assumed(0.98, "discount per decision step", gt=0.0, le=1.0)
    gae_lambda: float = assumed(0.95, "GAE", gt=0.0, le=1.0)
    hidden: Layers = assumed((128, 128), "layers of actor and value network")
    entropy: float = assumed(0.0, "entropy bonus", ge=0.0)
    log_std_init: float = assumed(-0.3, "initial exploration")
    log_std_floor: float = assumed(-1.2, "keeps exploring, so that the multiplier can act")
    cost_limit: Annotated[float, Field(ge=0.0)] | Literal["auto"] = assumed(
        25.0,
        "kappa per 1000 env steps; the benchmark's convention; `auto`: a tenth of what random "
        "commands cost, from 1 to 25, which is the default on tasks of one's own",
    )
    late_cost_limit: float | None = assumed(
        None,
        "another kappa from half of the training on: an expert that costs kappa is hardly "
        "worth imitating",
        ge=0.0,
    )
    multiplier_init: float = assumed(
        0.3, "penalty per costly decision step from the first update", ge=0.0
    )
    multiplier_lr: float = assumed(
        0.01, "step of the multiplier per update and unit of relative excess cost", ge=0.0
    )
    multiplier_min: float = assumed(
        0.05,
        "lower bound of the multiplier: untrained policies cost little, and would lower it to "
        "nothing before it is needed",
        ge=0.0,
    )
    multiplier_max: float = assumed(
        5.0,
        "upper bound of the multiplier; with a small kappa it rises to this bound, and a policy "
        "may stand still",
        gt=0.0,
    )
    checkpoints: tuple[float, ...] = assumed(
        (0.10, 0.25, 0.50, 1.00), "fractions of the interactions at which a skill is stored"
    )
    evaluation_episodes: int = assumed(
        64, "episodes of the final evaluation of each checkpoint", ge=1
    )
    bars: dict[str, Bars] = assumed(
        {},
        "by task, what the expert has to reach, or its training goes on; the experts of other "
        "tasks are taken as they are",
    )
    acceptance_episodes: int = assumed(
        256,
        "fresh layouts on which the expert is compared with the bars; they determine a share of "
        ".7 to about .03",
        ge=1,
    )
    extension: int = assumed(
        200_000, "decision steps of each further training of an expert that falls short", ge=1
    )
    extensions: int = assumed(2, "most further trainings", ge=0)

    @model_validator(mode="after")
    def _checkpoints_rise_to_one(self) -> ExpertConfig:
        rising = list(self.checkpoints) == sorted(set(self.checkpoints))
        if (
            not rising
            or not self.checkpoints
            or self.checkpoints[-1] != 1.0
            or self.checkpoints[0] <= 0
        ):
            raise ValueError("checkpoints must rise and end at 1.0")
        return self


class MixtureConfig(Config):
    """Shares of the behaviours in the dataset; they must sum to 1."""

    expert: float = assumed(0.23, "expert with Gaussian noise 0.25", ge=0.0, le=1.0)
    noisy: float = assumed(
        0.10, "uniform replacement with probability 0.2, 0.4 or 0.6", ge=0.0, le=1.0
    )
    laggy: float = assumed(0.12, "repetition with probability 0.5, 0.7 or 0.85", ge=0.0, le=1.0)
    delayed: float = assumed(
        0.14, "the command for what was seen 2, 3 or 5 decision steps ago", ge=0.0, le=1.0
    )
    early: float = assumed(0.05, "the first two checkpoints", ge=0.0, le=1.0)
    bursts: float = assumed(
        0.08, "expert interrupted by random commands held for 2-11 steps", ge=0.0, le=1.0
    )
    careless: float = assumed(
        0.20,
        "repetition with probability 0.9 or 0.95: commands held for a second and more",
        ge=0.0,
        le=1.0,
    )
    random: float = assumed(0.08, "uniform random commands", ge=0.0, le=1.0)

    @model_validator(mode="after")
    def _shares_sum_to_one(self) -> MixtureConfig:
        total = sum(getattr(self, name) for name in type(self).model_fields)
        if abs(total - 1.0) > 1e-6:
            raise ValueError(f"the shares sum to {total:g}, not 1")
        return self


class DatasetConfig(Config):
    """Episodes with images from a mixture of behaviours."""

    steps: int = assumed(100_000, "decision steps", ge=1)
    envs: int = assumed(16, "episodes side by side; one shard each", ge=1)
    mixture: MixtureConfig = MixtureConfig()
