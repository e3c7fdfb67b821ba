"""A ridge regression from latents to the privileged vector, judged on other rows. N rows, K starts,
F features, P entries of the vector.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator, roll_prior
from wasp_cli.learning.shards import Recording
from wasp_cli.models.world_model import SafetyWorldModel

CHUNK = 256  # observations that are embedded, or starts that are imagined, together
CONSTANT = 1e-3  # standard deviation below which an entry of the vector counts as constant
EPSILON = 1e-6  # keeps the equations solvable where the features do not vary at all
Floats = NDArray[Any]
Groups = Mapping[str, slice]


class Ridge(NamedTuple):
    """A linear map to the standardised privileged vector."""

    centre: Tensor  # float64 [F] mean of the features
    weight: Tensor  # float64 [F, P]
    mean: Floats  # [P] of the vector
    std: Floats  # [P] of the vector; 0 where an entry is constant, and is not predicted

    def explained(self, features: Tensor, privileged: Floats, groups: Groups) -> dict[str, float]:
        """Return R2 by group: the explained share of the variance of its entries, each in units of
        its standard deviation.

        Args:
            features: [N, F].
            privileged: [N, P] true vectors.
            groups: entries of each group. The R2 of a group whose entries do not vary is NaN.
        """
        predicted = ((features.double() - self.centre) @ self.weight).numpy()
        true = _standardised(privileged, self.mean, self.std)
        error = ((predicted - true) ** 2).mean(0)
        variance = true.var(0)
        return {
            name: _explained(float(error[part].sum()), float(variance[part].sum()))
            for name, part in groups.items()
        }


def fit_ridge(features: Tensor, privileged: Floats, penalty: float) -> Ridge:
    """Fit features [N, F] to the standardised privileged vector [N, P].

    Args:
        features: they are centred, but not scaled, so that a class of z that is hardly ever drawn
            does not count as much as a common one.
        privileged: its constant entries are left out.
        penalty: on the squared weights per row, relative to the mean variance of the features.
    """
    # -- standardise the vectors, and centre the features
    mean = privileged.mean(0, dtype=np.float64)
    deviation = privileged.std(0, dtype=np.float64)
    std = np.where(deviation > CONSTANT, deviation, 0.0)
    target = torch.from_numpy(_standardised(privileged, mean, std))
    centre = features.double().mean(0)
    centred = features.double() - centre

    # -- normal equations, with the penalty on their diagonal
    gram = centred.T @ centred
    ridge = penalty * gram.diagonal().mean() + EPSILON
    identity = torch.eye(len(gram), dtype=gram.dtype)
    weight = torch.linalg.solve(gram + ridge * identity, centred.T @ target)
    return Ridge(centre, weight, mean, std)


@dataclass(frozen=True)
class StateReadout:
    """A regression from the filtered latent and one from the encoder's embedding, fitted on the
    same rows.
    """

    model: SafetyWorldModel
    groups: Groups
    latent: Ridge
    embedding: Ridge

    @classmethod
    def fit(
        cls,
        model: SafetyWorldModel,
        recording: Recording,
        latents: Latents,
        groups: Groups,
        penalty: float,
    ) -> StateReadout:
        """Fit both.

        Args:
            model: embeds the observations.
            recording: what the model reads and privileged of N rows that may be learned from.
            latents: filtered latents of the N rows.
            groups: entries of the privileged vector by name.
            penalty: see `fit_ridge`.
        """
        all_rows = torch.arange(len(recording.privileged))
        from_latents = fit_ridge(latents.at(all_rows).features, recording.privileged, penalty)
        embedded = embeddings(model, recording.seen)
        from_embeddings = fit_ridge(embedded, recording.privileged, penalty)
        return cls(model, groups, from_latents, from_embeddings)

    def filtered(self, recording: Recording, latents: Latents) -> dict[str, float]:
        """Return R2 by group from the filtered latents of N rows."""
        features = latents.at(torch.arange(len(recording.privileged))).features
        return self.latent.explained(features, recording.privileged, self.groups)

    def embedded(self, recording: Recording) -> dict[str, float]:
        """Return R2 by group from the single observations of N rows."""
        return self.embedding.explained(
            embeddings(self.model, recording.seen), recording.privileged, self.groups
        )

    def imagined(
        self,
        recording: Recording,
        latents: Latents,
        starts: NDArray[np.int64],
        step: int,
        samples: int,
        seed: int,
    ) -> dict[str, float]:
        """Return R2 by group from latents that are imagined under the recorded actions, `step`
        steps ahead of K starts; NaN without a start.
        """
        if not len(starts):
            return dict.fromkeys(self.groups, float("nan"))
        features = imagined_features(self.model, recording, latents, starts, step, samples, seed)
        return self.latent.explained(features, recording.privileged[starts + step], self.groups)


@torch.inference_mode()
def embeddings(model: SafetyWorldModel, seen: NDArray[Any]) -> Tensor:
    """Return the embeddings [N, F] of single images, uint8 [N, 6, 64, 64], or vectors [N, S]."""
    parts = [
        model.encoded(torch.from_numpy(seen[begin : begin + CHUNK]))
        for begin in range(0, len(seen), CHUNK)
    ]
    return torch.cat(parts)


@torch.inference_mode()
def imagined_features(
    model: SafetyWorldModel,
    recording: Recording,
    latents: Latents,
    starts: NDArray[np.int64],
    step: int,
    samples: int,
    seed: int,
) -> Tensor:
    """Return the features [K, F] that are imagined `step` steps ahead of K starts under the
    recorded actions: means over samples of the prior.
    """
    source = generator(seed)
    parts: list[Tensor] = []
    for begin in range(0, len(starts), CHUNK):
        rows = starts[begin : begin + CHUNK]
        actions = torch.from_numpy(recording.action[rows[:, None] + 1 + np.arange(step)])
        start = latents.at(torch.from_numpy(rows))
        futures = [
            roll_prior(model, start, actions, source).features[:, -1] for _ in range(samples)
        ]
        parts.append(torch.stack(futures).mean(0))
    return torch.cat(parts)


def _standardised(privileged: Floats, mean: Floats, std: Floats) -> Floats:
    """Return vectors [N, P] in units of their standard deviation, constant entries as zero."""
    scale = np.where(std > 0, std, 1.0)
    vectors: Floats = np.where(std > 0, (privileged - mean) / scale, 0.0)
    return vectors


def _explained(error: float, variance: float) -> float:
    return float(1.0 - error / variance) if variance > 0 else float("nan")
