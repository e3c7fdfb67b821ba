"""Diffusion's denoiser of expert actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import DenoiserConfig


class DenoiserStage:
    """Diffusion's denoiser of expert actions."""

    kind = "denoiser"
    config = DenoiserConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("dataset", "world_model")

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.denoiser import train_denoiser

        return train_denoiser(job)
