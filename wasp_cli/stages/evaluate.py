"""Evaluation of one cell of the grid: a method under one operator and one seed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import EvaluateConfig


class EvaluateStage:
    """Evaluation of one cell of the grid: a method under one operator and one seed."""

    kind = "evaluate"
    config = EvaluateConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.evaluation import evaluate_cell

        return evaluate_cell(job)
