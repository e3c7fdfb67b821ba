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

JUDGED = 4000  # about as many held-out decisions judge a model


class HeldOutDecisions(NamedTuple):
    """K decisions on held-out episodes of a dataset."""

    features: Tensor  # [K, F]
    expert: Tensor  # [K, A] the expert's own action
    executed: Tensor  # [K, A] what was executed


class LabelledStates(NamedTuple):
    """N recorded rows, labelled."""

    recording: Recording
    labels: Tensor  # [N, A] the expert's own action
    latents: Latents

    def held_out(self) -> HeldOutDecisions:
        """Return about `JUDGED` decisions, evenly spread over the held-out episodes."""
        # The action at row i + 1 is what was executed at the state of row i.
        is_held_out = self.recording.held_out(HELD_OUT)[:-1]
        is_decision = ~self.recording.first[1:].astype(bool)
        rows = torch.from_numpy(np.flatnonzero(is_held_out & is_decision))
        stride = max(1, len(rows) // JUDGED)
        rows = rows[::stride]
        return HeldOutDecisions(
            self.latents.at(rows).features,
            self.labels[rows],
            torch.from_numpy(self.recording.action)[rows + 1],
        )


def load_labelled(inputs: Mapping[str, Path]) -> LabelledStates:
    """Read the rows of a dataset with their latents, and label each with the expert's action.

    Args:
        inputs: artifact folders by stage kind; read are `dataset`, `latents` and `expert`.
    """
    recording = read_shards(inputs["dataset"], ["privileged", "action", "first", "episode"])
    with torch.inference_mode():
        labels = load_privileged(inputs["expert"], 1.0)(torch.from_numpy(recording.privileged))
    return LabelledStates(recording, labels.clone(), load_latents(inputs["latents"]))
