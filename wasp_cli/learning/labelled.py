"""Recorded states with the expert's own action at each, from which Diffusion and CSA learn. N =
recorded rows, A = action size.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from wasp_cli.learning.latents import Latents, load_latents
from wasp_cli.learning.shards import HELD_OUT, Recording, read_shards
from wasp_cli.models.policy import load_privileged

JUDGED = 4000  # held-out decisions at which a model is judged, about


class LabelledStates(NamedTuple):
    """N recorded rows."""

    recording: Recording
    labels: Tensor  # [N, A] the expert's own action
    latents: Latents

    @property
    def features(self) -> int:
        """Return the number of latent features of a row."""
        return self.latents.h.shape[1] + self.latents.z.shape[1] * self.latents.classes

    def held_out(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return features [K, F], the expert's actions [K, A] and those that were executed [K,
        A] at K held-out decisions.
        """
        # The action at row i + 1 is what was executed at the state of row i.
        held = torch.from_numpy(
            np.flatnonzero(
                self.recording.held_out(HELD_OUT)[:-1] & ~self.recording.first[1:].astype(bool)
            )
        )
        held = held[:: max(1, len(held) // JUDGED)]
        return (
            self.latents.at(held).features,
            self.labels[held],
            torch.from_numpy(self.recording.action)[held + 1],
        )


def load_labelled(inputs: Mapping[str, Path]) -> LabelledStates:
    """Read the rows of a dataset with their latents, and ask the expert about each; `inputs`
    are artifact folders by stage kind.
    """
    recording = read_shards(inputs["dataset"], ["privileged", "action", "first", "episode"])
    with torch.inference_mode():
        labels = load_privileged(inputs["expert"], 1.0)(torch.from_numpy(recording.privileged))
    return LabelledStates(recording, labels.clone(), load_latents(inputs["latents"]))
