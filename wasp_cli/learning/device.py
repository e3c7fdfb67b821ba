"""The device on which networks train and assistants decide: that of `WASP_DEVICE`, else a GPU that
torch sees, else the CPU. It is in no key.
"""

from __future__ import annotations

import os
from contextlib import AbstractContextManager

import torch

from wasp_cli.errors import UsageError

VARIABLE = "WASP_DEVICE"


def training_device() -> torch.device:
    """Return the device that `WASP_DEVICE` names, or the first GPU, or the CPU.

    Raises:
        UsageError: torch cannot use the device that is named.
    """
    wanted = os.environ.get(VARIABLE, "")
    if not wanted:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        torch.zeros(1, device=wanted)
        return torch.device(wanted)
    except (RuntimeError, AssertionError) as error:
        line = str(error).splitlines()[0]
        raise UsageError(
            f"torch cannot use the device that {VARIABLE}={wanted} names: {line}",
            f"unset {VARIABLE}, or set it to cpu",
        ) from error


def mixed_precision(device: torch.device) -> AbstractContextManager[object]:
    """Return a context with bfloat16 products on a GPU, and float32 on a CPU: most CPUs have no
    fast bfloat16.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda")
