"""The section of the stage `adversary`, in a file of its own so that the key of no other stage
covers it.
"""

from __future__ import annotations

from wasp_cli.config import Config, assumed


class AdversaryConfig(Config):
    """A disturbance of the imagined transitions, its calibrated budget, and its training."""

    hidden: int = assumed(
        128, "width of the two hidden layers (the original has four of 512)", ge=1
    )
    largest: float = assumed(15.0, "largest change of a logit, as in the authors' code", gt=0.0)
    mass: float = assumed(
        0.9,
        "only classes of the smallest set with this probability are promoted, as in the authors' "
        "code",
        gt=0.0,
        lt=1.0,
    )
    alpha: float = assumed(
        0.01,
        "share of the held-out trajectories that may leave the budget, as in the authors' code",
        gt=0.0,
        lt=1.0,
    )
    horizon: int = assumed(15, "imagined decisions, H of the gates", ge=1)
    updates: int = assumed(300, "gradient steps", ge=1)
    batch: int = assumed(64, "imagined rollouts per update", ge=1)
    learning_rate: float = assumed(
        1e-3, "Adam; decays linearly over the second half to a tenth", gt=0.0
    )
