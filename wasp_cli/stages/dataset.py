"""Dataset: episodes with images from a mixture of behaviours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import DatasetConfig


class DatasetStage:
    """Dataset: episodes with images from a mixture of behaviours."""

    kind = "dataset"
    config = DatasetConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("expert",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.dataset import collect_dataset

        return collect_dataset(job)
