"""Section of the reachability filter's safety value."""

from __future__ import annotations

from wasp_cli.config import Config, assumed


class ReachabilityConfig(Config):
    """Q of the discounted safety Bellman equation, on recorded transitions and on imagined ones."""

    hidden: int = assumed(128, "width of the two hidden layers", ge=1)
    updates: int = assumed(1500, "gradient steps", ge=1)
    batch: int = assumed(128, "recorded transitions per update, and as many imagined ones", ge=1)
    gamma: float = assumed(0.95, "discount per decision step", gt=0.0, lt=1.0)
    learning_rate: float = assumed(
        1e-3, "Adam; decays linearly over the second half to a tenth", gt=0.0
    )
    slow: float = assumed(
        0.05,
        "share of the online network that enters the target network per update",
        gt=0.0,
        le=1.0,
    )
