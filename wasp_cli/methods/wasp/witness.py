"""The second witness of the safety gate: a direct look ahead under the commands that the operator is imagined to issue."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from wasp_cli.errors import WaspError
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.models.base import Latent
from wasp_cli.models.lookahead import LookAhead
from wasp_cli.models.weights import load_module


@dataclass(frozen=True)
class Witness:
    """A trained look ahead, asked about one window."""

    model: LookAhead
    window: int
    """Decisions ahead"""

    @property
    def commands(self) -> int:
        """K: how many imagined commands it wants to hear."""
        return self.model.commands

    def foreseen(self, latent: Latent, issued: Tensor) -> Tensor:
        """Return the probability [B] of any cost within the window, a mean over imagined futures.

        Args:
            latent: filtered [B, .].
            issued: the operator's next K commands in M futures, [B, M, K, A]; the first is the one just issued.
        """
        return foreseen(self.model, latent, issued)[:, self.window - 1]


def foreseen(model: LookAhead, latent: Latent, issued: Tensor) -> Tensor:
    """Return the probability [B, H] of any cost within 1..H decisions, a mean over imagined futures; arguments as in `Witness.foreseen`."""
    futures = issued.shape[1]
    found: Tensor = model(latent.features.repeat_interleave(futures, 0), issued.flatten(0, 1))
    return found.view(-1, futures, found.shape[-1]).mean(1)


def load_witness(config: WASPConfig, folder: Path, device: torch.device | None = None) -> Witness:
    """Load the look ahead of an artifact of the stage `lookahead`.

    Raises:
        WaspError: it does not look as far as it is asked, or reads more commands than are imagined.
    """
    model = load_module(LookAhead, folder / "lookahead.safetensors").to(device)
    if config.head_window > model.horizon:
        raise WaspError(
            f"wasp.head_window is {config.head_window}, but the look ahead ends after {model.horizon} decisions",
            "lower wasp.head_window, or raise lookahead.horizon",
        )
    if model.commands > config.horizon:
        raise WaspError(
            f"the look ahead reads {model.commands} commands, of which wasp.horizon imagines {config.horizon}", "lower lookahead.commands"
        )
    return Witness(model, config.head_window)
