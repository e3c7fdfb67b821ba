"""SafeRL-Res: a residual policy trained in the real task through the filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import ResidualConfig


class ResidualStage:
    """SafeRL-Res: a residual policy trained in the real task through the filter."""

    kind = "residual"
    config = ResidualConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.residual import train_residual

        return train_residual(job)
