"""Weights in the precision in which they are stored, so that a published cell can be computed again
with exactly the weights that it was computed with.
"""

from __future__ import annotations

import copy
from typing import TypeVar

import torch
from torch import nn

from wasp_cli.errors import TrainingError

M = TypeVar("M", bound=nn.Module)


def rounded(module: M) -> M:
    """Round the floating-point weights and buffers of a trained module to 16 bits in place, and
    return a copy in 16 bits, which is stored.

    What a stage measures on `module` afterwards is measured on what is stored.

    Raises:
        TrainingError: a weight does not fit into 16 bits.
    """
    smaller = copy.deepcopy(module).half()
    for name, tensor in smaller.state_dict().items():
        if tensor.dtype == torch.float16 and not bool(torch.isfinite(tensor).all()):
            raise TrainingError(
                f"weight '{name}' does not fit into 16 bits",
                "training diverged: lower the stage's learning rate",
            )
    module.load_state_dict(smaller.state_dict())
    return smaller
