"""The trained world model of an artifact."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from wasp_cli.models.weights import load_module, save_weights
from wasp_cli.models.world_model import SafetyWorldModel, Sizes


def save_world_model(model: SafetyWorldModel, folder: Path) -> None:
    """Write `world_model.safetensors` and its sizes."""
    save_weights(model, folder / "world_model.safetensors", **asdict(model.sizes))


def load_world_model(folder: Path) -> SafetyWorldModel:
    """The frozen model of a world-model artifact."""
    return load_module(lambda **sizes: SafetyWorldModel(Sizes(**sizes)), folder / "world_model.safetensors")
