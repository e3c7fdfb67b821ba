"""What a decision imagines, in full: latents along rollouts of the commands alone and of a correction, and where they lead on the map.

`methods.wasp.imagine` keeps only the returns of such rollouts. A latent has no position, but how the robot has moved can be read out of it:
a ridge regression from the features of an arrived latent to the robot's displacement within the decision, in the frame that it had before.

S = sequences (alone, corrected), M = rollouts, H = horizon, L = residual steps, A = action size, F = features, N = decisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.learning.sampling import generator, gumbel
from wasp_cli.models.base import Latent
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import DrawnNoise, Operator, Policy
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.frames import wrapped

ROLLOUTS = 6  # M: enough to show how far imagined futures lie apart
STRENGTHS = (1.0, 10.0, 100.0, 1000.0, 10000.0)  # of the penalty; the best one on episodes that were left out is taken
FOLDS = 3
PARTS = 6  # of an episode that is alone: consecutive decisions, so that what is left out is not beside what is fitted


class RolloutStart(NamedTuple):
    """A decision from which futures are imagined."""

    t: int
    latent: Latent  # [1, .] filtered
    a_h: NDArray[np.float32]  # [A]
    operator: Operator  # who goes on, forked right after the command: S * M rows, sequence after sequence
    residuals: NDArray[np.float32]  # [S, L, A]: the first sequence is that of the commands alone, all zero


class ImaginedTrajectories(NamedTuple):
    """Imagined futures of one decision."""

    features: NDArray[np.float32]  # [S, M, H, F] of the arrived latents
    cost: NDArray[np.float32]  # [S, H] probability of a cost at the arrived states, mean over the rollouts
    images: dict[int, NDArray[np.float32]]  # by imagined step from 1 to H: [S, 6, 64, 64] in [0, 1], decoded from the first rollout


def rollout_start(
    t: int, latent: Latent, row: int, a_h: NDArray[np.float32], operator: Operator, residuals: NDArray[np.float32] | None, horizon: int
) -> RolloutStart:
    """Begin at row `row`; `residuals` [L, A] are those of a correction, None where there is none.

    The sequences share the draws of their rollouts, and the draws of a decision depend on `t` alone.
    """
    nothing = np.zeros((1, *np.shape(residuals)), np.float32) if residuals is not None else np.zeros((1, 1, len(a_h)), np.float32)
    sequences = nothing if residuals is None else np.concatenate([nothing, residuals[None].astype(np.float32)])
    draws = torch.rand((horizon, ROLLOUTS, operator.draws), generator=generator(2 * t)).repeat(1, len(sequences), 1)
    forked = operator.fork(torch.tensor([row]), len(draws[0]), DrawnNoise(draws))
    return RolloutStart(t, latent.rows(torch.tensor([row])), a_h, forked, sequences)


def following(expert: Policy, action_size: int, batch: int) -> Operator:
    """Return who goes on where the assistant imagines the expert behind a command: B = `batch` rows without a memory."""
    return Operator(expert, action_size, DrawnNoise(torch.zeros(0, batch, 0)), batch)


@torch.inference_mode()
def imagine(
    model: SafetyWorldModel, start: RolloutStart, horizon: int, shown: Sequence[int], *, hold: bool = False
) -> ImaginedTrajectories:
    """Imagine the sequences of a start over `horizon` steps, and decode the images of the `shown` ones; the same again gives the same.

    With `hold` residuals are added to the present command instead of the imagined ones, as Eq. 13 is printed.
    """
    sequences, steps, _ = start.residuals.shape
    begun = start.operator.snapshot()
    rows = sequences * ROLLOUTS
    noise = gumbel((horizon, ROLLOUTS, model.noise_size), generator(2 * start.t + 1)).repeat(1, sequences, 1)
    residuals = torch.from_numpy(start.residuals).repeat_interleave(ROLLOUTS, 0)  # [S * M, L, A]
    now = torch.from_numpy(start.a_h).expand(rows, -1)
    latent = start.latent.expand_rows(rows)
    features: list[Tensor] = []
    costs: list[Tensor] = []
    images: dict[int, NDArray[np.float32]] = {}
    for k in range(horizon):
        command = now if k == 0 else start.operator.command(latent.features)
        base = torch.cat([command[:ROLLOUTS], now[ROLLOUTS:]]) if hold else command  # of the first sequence the operator goes on
        action = (base + residuals[:, k]).clamp(-1, 1) if k < steps else command
        start.operator.observe(action)
        latent = model.imagine(latent, action, noise[k])
        features.append(latent.features)
        costs.append(model.cost(latent).view(sequences, ROLLOUTS).mean(1))
        if k + 1 in shown:
            images[k + 1] = model.decode(latent.rows(torch.arange(sequences) * ROLLOUTS)).numpy()
    start.operator.restore(begun)
    whole = torch.stack(features, 1).unflatten(0, (sequences, ROLLOUTS))
    return ImaginedTrajectories(whole.numpy(), torch.stack(costs, 1).numpy(), images)


@dataclass(frozen=True)
class Readout:
    """A linear map from features [F] to (forward, left, turn): m, m and rad within one decision."""

    mean: Floats  # [F]
    weights: Floats  # [F, 3], of centred features
    offset: Floats  # [3]

    def __call__(self, features: NDArray[Any]) -> Floats:
        """[..., F] to [..., 3]."""
        moves: Floats = (np.asarray(features, np.float64) - self.mean) @ self.weights + self.offset
        return moves

    def explained(self, features: NDArray[Any], moves: Floats) -> Floats:
        """Return R2 [3] on other decisions: features [N, F] with their displacements [N, 3]; NaN where these are all the same."""
        return _explained(self(features), moves)


def fit(features: Sequence[NDArray[Any]], moves: Sequence[Floats]) -> Readout:
    """Fit a readout to episodes, features [N_e, F] and moves [N_e, 3] each; its penalty is chosen by leaving episodes out."""
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


def fit_within(features: NDArray[Any], moves: Floats) -> tuple[Readout | None, Floats]:
    """Fit a readout to one episode, features [N, F] and moves [N, 3]: None where it is too short; its R2 [3], each part from the others."""
    if len(moves) < 2 * PARTS:
        return None, np.full(3, np.nan)
    xs, ys = np.array_split(features, PARTS), np.array_split(moves, PARTS)
    found = [fit(xs[:i] + xs[i + 1 :], ys[:i] + ys[i + 1 :])(xs[i]) for i in range(PARTS)]
    return fit(xs, ys), _explained(np.concatenate(found), moves)


def _ridges(features: NDArray[Any], moves: Floats) -> list[Readout]:
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
    """Turn poses [T, 3] (x, y, yaw) into displacements [T - 1, 3]: forward and left of the former pose in m, turn in rad."""
    before, after = places[:-1], places[1:]
    way, (sin, cos) = after[:, :2] - before[:, :2], (np.sin(before[:, 2]), np.cos(before[:, 2]))
    forward, left = way[:, 0] * cos + way[:, 1] * sin, way[:, 1] * cos - way[:, 0] * sin
    return np.stack([forward, left, wrapped(after[:, 2] - before[:, 2])], 1)


def integrated(start: Floats, moves: Floats) -> Floats:
    """Turn a pose [3] (x, y, yaw) and displacements [..., H, 3] into places [..., H + 1, 2] in m."""
    turned = start[2] + np.concatenate([np.zeros_like(moves[..., :1, 2]), np.cumsum(moves[..., 2], -1)], -1)[..., :-1]
    cos, sin = np.cos(turned), np.sin(turned)
    steps = np.stack([moves[..., 0] * cos - moves[..., 1] * sin, moves[..., 0] * sin + moves[..., 1] * cos], -1)
    begun = np.broadcast_to(start[:2], (*moves.shape[:-2], 1, 2))
    return np.concatenate([begun, start[:2] + np.cumsum(steps, -2)], -2)
