"""The section of the stage `fallback`, in a file of its own so that the key of no other stage
covers it.
"""

from __future__ import annotations

from wasp_cli.config import Config, assumed


class FallbackConfig(Config):
    """A safety critic and its actor, trained together as in SAC."""

    hidden: int = assumed(
        128,
        "width of the two hidden layers, of critic and actor (the original has three of 256)",
        ge=1,
    )
    updates: int = assumed(3000, "gradient steps (the original has 12.8 million env steps)", ge=1)
    batch: int = assumed(
        128, "recorded transitions per update, and as many imagined ones; as the original", ge=1
    )
    gamma: float = assumed(
        0.95,
        "discount per decision step, as in the stage `reachability` (the original has .992)",
        gt=0.0,
        lt=1.0,
    )
    learning_rate: float = assumed(
        1e-3,
        "Adam; decays linearly over the second half to a tenth (the original has 3e-4)",
        gt=0.0,
    )
    slow: float = assumed(
        0.05,
        "share of the online critic that enters the target critic per update",
        gt=0.0,
        le=1.0,
    )
    temperature: float = assumed(
        0.1, "weight of the entropy at the beginning; it is then learned, as in SAC", gt=0.0
    )
    entropy: float = assumed(
        -1.0, "target of the entropy per component of an action, as in SAC", ge=-5.0, le=0.5
    )
