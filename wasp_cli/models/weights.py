"""Weights on disk: safetensors, with the constructor's arguments as JSON beside them. Nothing is
unpickled, so that a file of weights cannot run code.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from wasp_cli.errors import ArtifactError

M = TypeVar("M", bound=nn.Module)


def save_weights(module: nn.Module, path: Path, **arguments: Any) -> None:
    """Write the weights of a module to `path` (.safetensors), and `arguments`, as JSON, to the path
    with the suffix .json.
    """
    # channels_last parameters are not contiguous; safetensors stores plain row-major tensors.
    tensors = {name: tensor.contiguous() for name, tensor in module.state_dict().items()}
    save_file(tensors, path)
    path.with_suffix(".json").write_text(json.dumps(arguments, sort_keys=True, indent=1))


def read_arguments(path: Path) -> dict[str, Any]:
    """Return the constructor's arguments from the JSON beside a weights file.

    Raises:
        ArtifactError: it cannot be read.
    """
    beside = path.with_suffix(".json")
    try:
        arguments: dict[str, Any] = json.loads(beside.read_text())
    except (OSError, ValueError) as error:
        raise ArtifactError(
            f"cannot read {beside}: {error}", "remove the artifact's folder and run again"
        ) from error
    return arguments


def load_weights(module: nn.Module, path: Path) -> None:
    """Fill `module` from `path` and freeze it.

    Raises:
        ArtifactError: the file cannot be read, or has weights of another module.
    """
    try:
        state = load_file(path)
        module.load_state_dict(state)
    except (OSError, SafetensorError, RuntimeError) as error:
        raise ArtifactError(
            f"cannot read {path}: {error}", "remove the artifact's folder and run again"
        ) from error
    module.eval().requires_grad_(False)


def load_module(build: Callable[..., M], path: Path) -> M:
    """Return a frozen module, built from the arguments beside `path` and filled from `path`.

    Raises:
        ArtifactError: a file cannot be read, or has weights of another module.
    """
    module = build(**read_arguments(path))
    load_weights(module, path)
    return module


def read_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Return all tensors of a safetensors file by name.

    Raises:
        ArtifactError: it cannot be read.
    """
    try:
        tensors: dict[str, torch.Tensor] = load_file(path)
    except (OSError, SafetensorError) as error:
        raise ArtifactError(
            f"cannot read {path}: {error}", "remove the artifact's folder and run again"
        ) from error
    return tensors
