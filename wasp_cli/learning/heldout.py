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
    tensors = {
        "h": heldout.latent.h,
        "z": heldout.latent.z,
        "a_h": heldout.a_h,
        "reward": heldout.reward,
        "cost": heldout.cost,
        "episode": heldout.episode,
        "terminal": heldout.terminal,
    }
    save_file(tensors, folder / "heldout.safetensors")


def load_heldout(folder: Path) -> Heldout:
    """Load the N rows of a held-out artifact."""
    tensors = read_tensors(folder / "heldout.safetensors")
    return Heldout(
        Latent(tensors["h"], tensors["z"]),
        tensors["a_h"],
        tensors["reward"],
        tensors["cost"],
        tensors["episode"],
        tensors["terminal"],
    )
