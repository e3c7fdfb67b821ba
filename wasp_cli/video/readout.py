"""Where imagined steps lead on the map: a latent has no position, but how the robot has moved can be read out of it.

A ridge regression from the features of an arrived latent to the robot's displacement within the decision, in the frame that it had before.
N = decisions, F = features, H = imagined steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.frames import wrapped

STRENGTHS = (1.0, 10.0, 100.0, 1000.0, 10000.0)
"""Of the penalty; the best one on episodes that were left out is taken."""
FOLDS = 3


@dataclass(frozen=True)
class Readout:
    """A linear map from features [F] to (forward, left, turn): m, m and rad within one decision."""

    mean: Floats
    """[F]"""
    weights: Floats
    """[F, 3], of centred features"""
    offset: Floats
    """[3]"""

    def __call__(self, features: NDArray[Any]) -> Floats:
        """[..., F] to [..., 3]."""
        moves: Floats = (np.asarray(features, np.float64) - self.mean) @ self.weights + self.offset
        return moves

    def explained(self, features: NDArray[Any], moves: Floats) -> Floats:
        """R2 [3] on other decisions: features [N, F] with the displacements [N, 3] that they had; NaN where these are all the same."""
        return _explained(self(features), moves)


def fit(features: Sequence[NDArray[Any]], moves: Sequence[Floats]) -> Readout:
    """A readout from episodes; their penalty is chosen by leaving episodes out.

    Args:
        features: [N_e, F] per episode.
        moves: [N_e, 3] per episode.

    Raises:
        ValueError: there is no decision to learn from.
    """
    folds = [[*range(i, len(features), FOLDS)] for i in range(min(FOLDS, len(features)))] if len(features) > 1 else []
    errors = np.zeros(len(STRENGTHS))
    for held in folds:
        rest = [e for e in range(len(features)) if e not in held]
        candidates = _ridges(np.concatenate([features[e] for e in rest]), np.concatenate([moves[e] for e in rest]))
        x, y = np.concatenate([features[e] for e in held]), np.concatenate([moves[e] for e in held])
        # Forward, left and turn weigh the same, whatever their units.
        errors += [np.nansum(1.0 - candidate.explained(x, y)) for candidate in candidates]
    best = int(np.argmin(errors)) if folds else len(STRENGTHS) // 2
    return _ridges(np.concatenate(features), np.concatenate(moves))[best]


def _ridges(features: NDArray[Any], moves: Floats) -> list[Readout]:
    """One readout per strength."""
    x = np.asarray(features, np.float64)
    if not len(x):
        raise ValueError("no decision to fit a readout to")
    mean, scale = x.mean(0), x.std(0)
    # What hardly ever varies would count most of all.
    scale = np.maximum(scale, max(1e-3 * float(scale.max()), 1e-12))
    z, offset = (x - mean) / scale, moves.mean(0)
    gram, right = z.T @ z, z.T @ (moves - offset)
    return [Readout(mean, np.linalg.solve(gram + strength * np.eye(len(gram)), right) / scale[:, None], offset) for strength in STRENGTHS]


def _explained(found: Floats, true: Floats) -> Floats:
    spread = ((true - true.mean(0)) ** 2).sum(0)
    error = ((found - true) ** 2).sum(0)
    shares: Floats = 1.0 - np.divide(error, spread, out=np.full(3, np.nan), where=spread > 1e-12)
    return shares


def displacements(places: Floats) -> Floats:
    """From poses [T, 3] (x, y, yaw) to the displacements [T - 1, 3] between them: forward and left of the former pose in m, turn in rad."""
    before, after = places[:-1], places[1:]
    way, (sin, cos) = after[:, :2] - before[:, :2], (np.sin(before[:, 2]), np.cos(before[:, 2]))
    forward, left = way[:, 0] * cos + way[:, 1] * sin, way[:, 1] * cos - way[:, 0] * sin
    return np.stack([forward, left, wrapped(after[:, 2] - before[:, 2])], 1)


def integrated(start: Floats, moves: Floats) -> Floats:
    """From a pose [3] and displacements [..., H, 3] to places [..., H + 1, 2]."""
    turned = start[2] + np.concatenate([np.zeros_like(moves[..., :1, 2]), np.cumsum(moves[..., 2], -1)], -1)[..., :-1]
    cos, sin = np.cos(turned), np.sin(turned)
    steps = np.stack([moves[..., 0] * cos - moves[..., 1] * sin, moves[..., 0] * sin + moves[..., 1] * cos], -1)
    begun = np.broadcast_to(start[:2], (*moves.shape[:-2], 1, 2))
    return np.concatenate([begun, start[:2] + np.cumsum(steps, -2)], -2)
