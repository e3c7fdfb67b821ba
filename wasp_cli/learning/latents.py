"""Filtered latents of recorded rows, in memory and on disk."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import save_file
from torch import Tensor

from wasp_cli.models.base import Latent
from wasp_cli.models.weights import read_tensors


class Latents(NamedTuple):
    """Filtered latents of N recorded rows, z as class indices."""

    h: Tensor  # [N, D]
    z: Tensor  # uint8 [N, S] class of each of the S variables
    classes: int  # classes of a variable; S x classes is the length Z of a one-hot z

    @property
    def features(self) -> int:
        """Return the number of features of a row: D + Z."""
        return self.h.shape[1] + self.z.shape[1] * self.classes

    def at(self, index: Tensor) -> Latent:
        """Return the latents of some rows [B]: h [B, D] as float32, and z [B, Z] one-hot."""
        one_hot = torch.nn.functional.one_hot(self.z[index].long(), self.classes).to(torch.float32)
        return Latent(self.h[index].float(), one_hot.flatten(-2))

    def rows(self, mask: Tensor) -> Latents:
        """Select the latents of a mask [N]."""
        return Latents(self.h[mask], self.z[mask], self.classes)


def save_latents(latents: Latents, folder: Path) -> None:
    """Write `latents.safetensors`: h as float16 [N, D], z as class indices [N, S]."""
    save_file(
        {"h": latents.h.half(), "z": latents.z, "classes": torch.tensor(latents.classes)},
        folder / "latents.safetensors",
    )


def load_latents(folder: Path) -> Latents:
    """Load the latents of a latents artifact, row for row those of its dataset."""
    tensors = read_tensors(folder / "latents.safetensors")
    return Latents(tensors["h"].float(), tensors["z"], int(tensors["classes"]))
