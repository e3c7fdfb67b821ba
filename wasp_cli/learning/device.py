"""Where networks are trained and assistants decide: on a GPU when torch sees one, else on the CPU; the code is the same.

`WASP_DEVICE=cpu` keeps a run off the GPU. A device enters no key: results on another device differ in rounding, as on another CPU.
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
            f"{VARIABLE}={wanted} names no device that torch can use here: {line}", f"unset {VARIABLE}, or set it to cpu"
        ) from error


def mixed_precision(device: torch.device) -> AbstractContextManager[object]:
    """Compute with bfloat16 products on a GPU; float32 on a CPU, most of which have no fast bfloat16."""
    return torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda")
