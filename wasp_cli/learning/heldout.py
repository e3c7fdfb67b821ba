"""Held-out decisions of the unimpaired expert on disk."""

from __future__ import annotations

from pathlib import Path

from safetensors.torch import save_file

from wasp_cli.methods.base import Heldout
from wasp_cli.models.base import Latent
from wasp_cli.models.weights import read_tensors


def save_heldout(heldout: Heldout, folder: Path) -> None:
    """Write `heldout.safetensors`: h [N, D], z [N, Z], a_h [N, A] and, [N] each, reward, cost,
    episode and terminal.
    """
    latent, *rest = heldout
    named = dict(zip(Heldout._fields[1:], rest, strict=True))
    save_file({"h": latent.h, "z": latent.z, **named}, folder / "heldout.safetensors")


def load_heldout(folder: Path) -> Heldout:
    """Load the N rows of a held-out artifact."""
    t = read_tensors(folder / "heldout.safetensors")
    return Heldout(
        Latent(t["h"], t["z"]), t["a_h"], t["reward"], t["cost"], t["episode"], t["terminal"]
    )
