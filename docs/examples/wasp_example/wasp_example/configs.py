"""What a spec can set, in the sections `careful` and `risk`."""

from __future__ import annotations

from wasp_cli.config import Config, assumed


class CarefulConfig(Config):
    """Careful: the least risky of three actions where a network expects cost of the command."""

    limit: float = assumed(
        0.3, "predicted probability of cost above which the command is replaced", gt=0.0, lt=1.0
    )


class RiskConfig(Config):
    """The network that predicts from state and action whether the next decisions cost."""

    window: int = assumed(8, "decisions, from the action on, within which a cost counts", ge=1)
    hidden: tuple[int, ...] = assumed((64, 64), "widths of the hidden layers")
    updates: int = assumed(2000, "gradient steps", ge=1)
    batch: int = assumed(256, "rows of a gradient step", ge=1)
    learning_rate: float = assumed(1e-3, "of Adam", gt=0.0)
