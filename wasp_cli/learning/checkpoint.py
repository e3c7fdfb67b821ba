"""The state of an interrupted training: weights, Adam moments, generator, as safetensors;
counters as JSON.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Protocol

import torch
from safetensors.torch import save_file
from torch import nn

from wasp_cli.errors import ArtifactError
from wasp_cli.models.weights import read_tensors

CHECKPOINT = "training.safetensors"


class HasTensors(Protocol):
    """Further state of a training."""

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the state by name."""
        ...

    def load(self, tensors: dict[str, torch.Tensor]) -> None:
        """Take back what `tensors` returned."""
        ...


def save_training(
    folder: Path,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    source: torch.Generator,
    counters: dict[str, Any],
    further: HasTensors | None = None,
) -> None:
    """Replace the checkpoint in `folder` atomically.

    Args:
        folder: where.
        module: all that is trained.
        optimizer: of its parameters.
        source: of all draws.
        counters: JSON values.
        further: other state, if there is any.
    """
    tensors: dict[str, torch.Tensor] = {}
    for name, tensor in module.state_dict().items():
        tensors[f"model/{name}"] = tensor.contiguous()
    for i, state in optimizer.state_dict()["state"].items():
        for name, value in state.items():
            tensors[f"optimizer/{i}/{name}"] = torch.as_tensor(value).contiguous()
    tensors["generator"] = source.get_state()
    if further is not None:
        for name, tensor in further.tensors().items():
            tensors[f"further/{name}"] = tensor
    partial = folder / "training.partial"
    save_file(tensors, partial, metadata={"counters": json.dumps(counters)})
    os.replace(partial, folder / CHECKPOINT)


def has_training(folder: Path) -> bool:
    """Return whether there is a checkpoint in `folder`."""
    return (folder / CHECKPOINT).exists()


def restore_training(
    folder: Path,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    source: torch.Generator,
    further: HasTensors | None = None,
) -> dict[str, Any] | None:
    """Load the checkpoint of `folder` into what it was saved from.

    Returns:
        Its counters; None where there is no checkpoint.

    Raises:
        ArtifactError: it cannot be read, or was written on another sort of device.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    from safetensors import safe_open

    tensors = read_tensors(path)
    with safe_open(path, "pt") as file:
        counters: dict[str, Any] = json.loads(file.metadata()["counters"])

    # -- weights and Adam moments
    module.load_state_dict(_below("model", tensors))
    state: dict[int, dict[str, Any]] = {}
    for name, tensor in _below("optimizer", tensors).items():
        index, moment = name.split("/")
        state.setdefault(int(index), {})[moment] = tensor
    optimizer.load_state_dict(
        {"state": state, "param_groups": optimizer.state_dict()["param_groups"]}
    )

    # -- the generator; those of a CPU and a GPU have states of different sizes
    try:
        source.set_state(tensors["generator"])
    except RuntimeError as error:
        raise ArtifactError(
            f"{path} was written on another device",
            f"go on there, or remove {folder} to begin anew",
        ) from error
    if further is not None:
        further.load(_below("further", tensors))
    return counters


def _below(folder: str, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the tensors called `folder/NAME`, by NAME."""
    prefix = f"{folder}/"
    return {
        name.removeprefix(prefix): tensor
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }
