"""What the sections of several stages have in common."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from wasp_cli.config import Config, assumed, deviates

# widths of hidden layers
Layers = Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]

LADDER: dict[str, tuple[float, ...]] = {
    "noisy": (0.2, 0.4, 0.6),
    "laggy": (0.5, 0.7, 0.85),
    "limited-skill": (0.50, 0.25, 0.10),
    "reaction-time": (0.16, 0.24, 0.40),
}


class ReturnsConfig(Config):
    """Constants of the TD-lambda returns (Eq. 7-8), shared by critics, gates and planner."""

    gamma_r: float = assumed(0.99, "discount of the reward return", gt=0.0, le=1.0)
    gamma_c: float = deviates(
        0.95,
        "discount of the cost return; Eq. 8 has one gamma for both, and V_c at 0.997 made "
        "the gate nearly useless",
        gt=0.0,
        le=1.0,
    )
    lam: float = assumed(0.95, "lambda, as in DreamerV3 and SafeDreamer", gt=0.0, le=1.0)
