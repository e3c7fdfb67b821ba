"""Where networks train and assistants decide: `WASP_DEVICE`, else a GPU that torch sees, else
the CPU. No key knows it.
"""

from __future__ import annotations

import os
from contextlib import AbstractContextManager

import torch

from wasp_cli.errors import UsageError

VARIABLE = "WASP_DEVICE"


def training_device() -> torch.device:
    """Return the device that `WASP_DEVICE` names, or the first GPU, or the CPU."""
    wanted = os.environ.get(VARIABLE, "")
    if not wanted:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        torch.zeros(1, device=wanted)
        return torch.device(wanted)
    except (RuntimeError, AssertionError) as error:
        line = str(error).splitlines()[0]
        raise UsageError(
            f"{VARIABLE}={wanted} names no device that torch can use here: {line}",
            f"unset {VARIABLE}, or set it to cpu",
        ) from error


def mixed_precision(device: torch.device) -> AbstractContextManager[object]:
    """Compute with bfloat16 products on a GPU; float32 on a CPU, most of which have no fast
    bfloat16.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda")
