"""Critics: V_r and V_c on imagined rollouts of the nominal expert (Eq. 7-8)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import CriticsConfig


class CriticsStage:
    """Critics: V_r and V_c on imagined rollouts of the nominal expert (Eq. 7-8)."""

    kind = "critics"
    config = CriticsConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("dataset", "world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.critics import train_critics

        return train_critics(job)
