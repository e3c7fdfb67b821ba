"""Section of the severities that a spec leaves open (`auto`): how much they are to impair, and how
that is measured.
"""

from __future__ import annotations

from wasp_cli.config import Config, assumed


class SeverityConfig(Config):
    """An operator without assistance on held-out worlds, at a few severities."""

    kept: float = assumed(
        0.6,
        "share that an operator of severity `auto` keeps of the way from random commands' return "
        "to the unimpaired latent expert's: about what the moderate operators of Table 1 keep",
        gt=0.0,
        lt=1.0,
    )
    episodes: int = assumed(
        20, "held-out episodes of each severity that is tried, the same worlds for all", ge=1
    )
