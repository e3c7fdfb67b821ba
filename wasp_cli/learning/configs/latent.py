"""Sections of what is learned on latents: policies, critics, clones of operators."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from wasp_cli.config import Config, assumed, deviates, from_paper
from wasp_cli.learning.configs.shared import Layers


class ReinforceConfig(Config):
    """PPO with a Lagrange multiplier on the latents, from the distilled expert; only where the
    labels alone were not enough.
    """

    interactions: int = assumed(
        200_000, "decision steps; 0 leaves the latent expert as it was distilled", ge=0
    )
    return_share: float = assumed(
        0.85,
        "latent return / privileged return at which a policy within the allowed cost is not "
        "reinforced; the labelling rounds may aim higher",
        gt=0.0,
    )
    envs: int = assumed(32, "episodes side by side", ge=1)
    rollout: int = assumed(128, "decision steps per environment and update", ge=1)
    epochs: int = assumed(4, "passes over a rollout", ge=1)
    batch: int = assumed(512, "minibatch", ge=2)
    learning_rate: float = assumed(
        2e-4, "Adam; decays linearly to a tenth; low, so that what was distilled is kept", gt=0.0
    )
    gamma: float = assumed(0.98, "discount per decision step", gt=0.0, le=1.0)
    log_std_init: float = assumed(-1.2, "initial exploration")
    log_std_floor: float = assumed(-1.6, "keeps exploring")
    value_warmup: float = assumed(
        0.08, "share of the interactions that train only the value function", ge=0.0, lt=1.0
    )
    multiplier_init: float = assumed(0.2, "penalty per costly decision step", ge=0.0)
    multiplier_lr: float = assumed(
        0.02, "step of the multiplier per update and unit of relative excess cost", ge=0.0
    )
    multiplier_min: float = assumed(0.05, "lower bound of the multiplier", ge=0.0)
    multiplier_max: float = assumed(5.0, "upper bound of the multiplier", gt=0.0)


class PoliciesConfig(Config):
    """Latent actors distilled from the expert checkpoints, rounds in which they drive and the
    checkpoints label, and reinforcement.
    """

    hidden: Layers = assumed((128, 128), "layers of a latent actor")
    updates: int = assumed(1500, "gradient steps of the distillation", ge=1)
    batch: int = assumed(512, "latents per update", ge=1)
    learning_rate: float = assumed(1e-3, "Adam, linear decay", gt=0.0)
    imagined_share: float = assumed(
        0.25,
        "share of the latents that are prior samples, as operators meet them in imagination",
        ge=0.0,
        le=1.0,
    )
    imagined_depth: int = assumed(
        5, "most prior steps from a recorded latent to such a sample", ge=1
    )
    labelling_rounds: int = assumed(
        3, "most on-policy labelling rounds; they end when return and cost are reached", ge=0
    )
    labelling_episodes: int = assumed(
        48, "episodes per round; the labels of more layouts teach more", ge=1
    )
    labelling_updates: int = assumed(1500, "gradient steps per round", ge=1)
    labelled_share: float = assumed(
        0.5, "share of a round's batches that comes from the rounds so far", ge=0.0, le=1.0
    )
    driver_share: float = assumed(
        0.4,
        "share of a round's episodes driven by impaired experts and earlier skills",
        ge=0.0,
        le=1.0,
    )
    reinforce: ReinforceConfig = ReinforceConfig()
    return_share: float = assumed(0.85, "least latent return / privileged return", gt=0.0)
    cost_ratio: float = assumed(1.3, "most latent cost / privileged cost", ge=0.0)
    cost_allowance: Annotated[float, Field(ge=0.0)] | Literal["auto"] = assumed(
        2.5,
        "cost per 1000 env steps above the privileged one that is always allowed; kappa / 10; "
        "`auto`: a tenth of the expert's cost_limit, which is the default on tasks of one's own",
    )
    evaluation_episodes: int = assumed(
        48,
        "episodes that judge a round, and others that evaluate each skill; they determine the "
        "share of the return to about .05",
        ge=1,
    )


class CriticsConfig(Config):
    """V_r and V_c of the nominal expert, from imagined rollouts and from recorded transitions."""

    hidden: Layers = assumed((128, 128), "layers of a critic")
    updates: int = assumed(1000, "gradient steps; curve.json shows whether V_r has converged", ge=1)
    starts: int = assumed(128, "imagined rollouts per update, and as many recorded segments", ge=1)
    horizon: int = from_paper(15, "H", ge=1)
    bins: int = assumed(
        63, "bins, evenly spaced in symlog, over which a value is a distribution; odd", ge=3
    )
    reach: float = assumed(1000.0, "largest value that the bins represent", gt=0.0)
    learning_rate: float = assumed(
        1e-3, "Adam; decays linearly over the second half to a tenth", gt=0.0
    )
    slow: float = assumed(
        0.2,
        "share of the online critic that enters the target critic per update; at 0.02 V_r "
        "needs thousands of updates",
        gt=0.0,
        le=1.0,
    )
    recorded: float = deviates(
        0.3,
        "weight of a second target of V: Q of recorded transitions, read at the expert's action, "
        "as the replay loss of DreamerV3's critic; the paper has latent roll-outs alone (0), and "
        "V learns their drift",
        ge=0.0,
    )
    q_updates: int = assumed(2500, "gradient steps of Q", ge=1)
    q_batch: int = assumed(256, "recorded transitions per update of Q", ge=1)
    q_learning_rate: float = assumed(
        5e-4, "Adam; decays linearly over the second half to a tenth", gt=0.0
    )
    q_slow: float = assumed(
        0.1,
        "share of the online Q that enters the target per update; a reward travels back "
        "one decision in 1 / q_slow",
        gt=0.0,
        le=1.0,
    )


class CloneConfig(Config):
    """A policy fitted to the recorded commands of a person."""

    hidden: Layers = assumed((64,), "layers of the correction of the expert's command")
    updates: int = assumed(1000, "gradient steps", ge=1)
    batch: int = assumed(256, "commands per update", ge=1)
    learning_rate: float = assumed(2e-3, "Adam; decays linearly", gt=0.0)
    weight_decay: float = assumed(0.1, "AdamW; high, because episodes are few", ge=0.0)
