"""Calibration of one method's thresholds on the held-out episodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import CalibrationConfig


class CalibrationStage:
    """Calibration of one method's thresholds on the held-out episodes."""

    kind = "calibration"
    config = CalibrationConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("heldout", "world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.calibration import calibrate

        return calibrate(job)
