"""IDA's Q ensemble: TD on real and noisy transitions for the expert policy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import EnsembleConfig


class IDAQStage:
    """IDA's Q ensemble: TD on real and noisy transitions for the expert policy."""

    kind = "ida_q"
    config = EnsembleConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("dataset", "world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.ensemble import train_ensemble

        return train_ensemble(job)
