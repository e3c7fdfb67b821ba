"""Policies: latent actors distilled from every expert checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import PoliciesConfig


class PoliciesStage:
    """Policies: latent actors distilled from every expert checkpoint."""

    kind = "policies"
    config = PoliciesConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("expert", "dataset", "world_model")

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.policies import distil_policies

        return distil_policies(job)
