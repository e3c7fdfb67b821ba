"""Expert: PPO with an adaptive Lagrange multiplier on privileged observations; a skill per checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import ExpertConfig


class ExpertStage:
    """Expert: PPO with an adaptive Lagrange multiplier on privileged observations; a skill per checkpoint."""

    kind = "expert"
    config = ExpertConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ()

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.expert import train_expert

        return train_expert(job)
