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

    def tensors(self) -> dict[str, torch.Tensor]: ...

    def load(self, tensors: dict[str, torch.Tensor]) -> None: ...


def save_training(
    folder: Path,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    source: torch.Generator,
    counters: dict[str, Any],
    further: HasTensors | None = None,
) -> None:
    """Replace the checkpoint in `folder` atomically."""
    tensors = {f"model/{name}": tensor.contiguous() for name, tensor in module.state_dict().items()}
    for i, state in optimizer.state_dict()["state"].items():
        tensors |= {
            f"optimizer/{i}/{name}": torch.as_tensor(value).contiguous()
            for name, value in state.items()
        }
    tensors["generator"] = source.get_state()
    if further is not None:
        tensors |= {f"further/{name}": tensor for name, tensor in further.tensors().items()}
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
    """Load the checkpoint of `folder` into its owners and return its counters; None when there
    is none.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    from safetensors import safe_open

    tensors = read_tensors(path)
    with safe_open(path, "pt") as file:
        counters: dict[str, Any] = json.loads(file.metadata()["counters"])
    module.load_state_dict(
        {name.removeprefix("model/"): t for name, t in tensors.items() if name.startswith("model/")}
    )
    state: dict[int, dict[str, Any]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimizer/"):
            _, index, key = name.split("/")
            state.setdefault(int(index), {})[key] = tensor
    optimizer.load_state_dict(
        {"state": state, "param_groups": optimizer.state_dict()["param_groups"]}
    )
    try:
        source.set_state(tensors["generator"])
    except RuntimeError as error:
        # the generators of a CPU and a GPU have states of different sizes
        raise ArtifactError(
            f"{path} was written on another device",
            f"go on there, or remove {folder} to begin anew",
        ) from error
    if further is not None:
        further.load(
            {
                name.removeprefix("further/"): t
                for name, t in tensors.items()
                if name.startswith("further/")
            }
        )
    return counters
