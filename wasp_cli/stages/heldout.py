"""Held-out episodes of the unimpaired expert, from which every threshold is taken."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import HeldoutConfig


class HeldoutStage:
    """Held-out episodes of the unimpaired expert, from which every threshold is taken."""

    kind = "heldout"
    config = HeldoutConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.heldout import record_heldout

        return record_heldout(job)
