"""From artifacts to an assistant."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from wasp_cli.config import Config
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.methods.base import Assistant, AssistantClass, Parts
from wasp_cli.methods.registry import METHODS
from wasp_cli.models.policy import load_skills
from wasp_cli.models.world_model import load_world_model
from wasp_cli.tasks.motors import UNKNOWN, Motors


def load_parts(
    inputs: Mapping[str, Path],
    returns: ReturnsConfig,
    device: torch.device | None = None,
    *,
    motors: Motors = UNKNOWN,
) -> Parts:
    """Load the frozen models of a training chain to a device (the CPU), and the calibrated
    thresholds where there are any.
    """
    thresholds: dict[str, float] = {}
    if "calibration" in inputs:
        thresholds = json.loads((inputs["calibration"] / "calibration.json").read_text())
    return Parts(
        load_world_model(inputs["world_model"]).to(device),
        load_skills(inputs["policies"]).to(device),
        inputs,
        thresholds,
        returns.gamma_r,
        returns.gamma_c,
        returns.lam,
        motors,
    )


def method_config(method: str, resolved: Mapping[str, Any]) -> Config:
    """Return the validated configuration of a method from its resolved JSON form."""
    return METHODS[method].config_model().model_validate(resolved)


def build_assistant(method: str, resolved: Mapping[str, Any], parts: Parts) -> Assistant:
    """Build an assistant by its registered name."""
    cls: AssistantClass = METHODS.load(method)
    return cls(method_config(method, resolved), parts)
