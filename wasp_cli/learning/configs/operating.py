"""Section of the operating points: the values of an assistant's knob that race on held-out worlds
before the assistant is evaluated.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from wasp_cli.config import Config, assumed
from wasp_cli.learning.configs.shared import LADDER

Values = Annotated[tuple[float, ...], Field(min_length=1)]  # of a knob


class OperatingConfig(Config):
    """The values of an assistant's knob beside the operators alone, on the same held-out worlds."""

    episodes: int = assumed(
        30,
        "held-out episodes of one assistant, over all values of its knob; at most half of the "
        "smallest evaluation that the preset is meant for: two operators, one seed",
        ge=1,
    )
    values: dict[str, Values] = assumed(
        {},
        "by assistant, values of its knob that replace its own; they enter the key of this "
        "assistant alone",
        in_key=False,
    )
    operators: dict[str, tuple[float, ...]] = assumed(
        LADDER,
        "operators who drive, one in each episode; by default those of the dataset",
        min_length=1,
    )
