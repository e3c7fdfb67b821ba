"""The direct look ahead: learned from recorded rows, and judged on held-out episodes beside the world model's rolled-out costs.

N recorded rows, R of them chosen, H decisions ahead, K commands, A actions. Decision k of a row is the one that arrives k rows later.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.errors import TrainingError
from wasp_cli.learning.configs.latent import LookaheadConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator, roll_prior
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.metrics.ranking import average_precision, average_precision_interval
from wasp_cli.metrics.reliability import calibration_error, reliability
from wasp_cli.models.lookahead import LookAhead
from wasp_cli.models.world_model import SafetyWorldModel

WINDOWS = (5, 10, 15)
"""Decisions ahead at which the look ahead is judged, as far as it looks."""
CHUNK = 512
"""Rows that are judged together."""


class Ahead(NamedTuple):
    """What followed R rows, as far as it was recorded."""

    rows: NDArray[np.int64]
    """[R]"""
    command: NDArray[np.float32]
    """[R, H, A] what was executed; zeros after the end of the episode"""
    cost: NDArray[np.bool_]
    """[R, H] the decision cost"""
    known: NDArray[np.bool_]
    """[R, H] it is known whether it did: the episode went on, or had ended by the task's own rule, after which nothing costs"""

    @property
    def at_risk(self) -> NDArray[np.bool_]:
        """[R, H] what is known of it, and no cost came before."""
        before: NDArray[np.int64] = np.cumsum(self.cost, 1) - self.cost
        risk: NDArray[np.bool_] = self.known & (before == 0)
        return risk

    def any_within(self, window: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return whether anything cost within a window [R], and whether that is known [R]: a cost before a time limit is enough."""
        event = self.cost[:, :window].sum(1) > 0
        return event, event | self.known[:, window - 1]


def what_followed(recording: Recording, rows: NDArray[np.int64], horizon: int) -> Ahead:
    """Return what followed `rows` [R]; a row that ended its episode has nothing ahead, and should not be among them."""
    last = np.searchsorted(recording.episode, recording.episode[rows], side="right")[:, None] - 1  # [R, 1]
    ahead = rows[:, None] + 1 + np.arange(horizon)
    within, follow = ahead <= last, np.minimum(ahead, last)
    over = recording.terminal[last] > 0  # [R, 1]
    command = np.where(within[..., None], recording.action[follow], np.float32(0.0))
    return Ahead(rows, command, (recording.cost[follow] > 0) & within, within | over)


def decisions(recording: Recording) -> NDArray[np.int64]:
    """Return the rows [R] after which a decision was recorded."""
    return np.flatnonzero(recording.episode[:-1] == recording.episode[1:])


def train_lookahead(
    recording: Recording, latents: Latents, config: LookaheadConfig, seed: int, report: Callable[[float, str], None]
) -> tuple[LookAhead, list[dict[str, float]]]:
    """Fit the hazards of all members to the recorded rows of the episodes that are not held out, by maximum likelihood.

    Args:
        recording: action, cost, terminal and episode of N rows.
        latents: of the same rows.
        config: sizes and budget.
        seed: of the batches and the dropout.
        report: called every 50 updates.

    Returns:
        The frozen look ahead, and its loss over the updates.

    Raises:
        TrainingError: no row may be learned from.
    """
    rows = decisions(recording)
    rows = rows[~recording.held_out(HELD_OUT)[rows]]
    if not len(rows):
        raise TrainingError("the dataset has no decision to learn from", "raise dataset.steps")
    ahead = what_followed(recording, rows, config.horizon)
    chosen, command, cost, at_risk = (torch.from_numpy(x) for x in (rows, ahead.command, ahead.cost, ahead.at_risk))
    features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
    model = LookAhead(config.members, features, command.shape[-1], config.commands, config.hidden, config.horizon, config.dropout)
    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate, fused=True)
    source = generator(seed)
    torch.manual_seed(seed)  # dropout knows no generator of its own
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    for update in range(config.updates):
        index = torch.randint(len(chosen), (config.batch,), generator=source)
        seen = latents.at(chosen[index]).features
        loss = model.loss(seen, command[index], cost[index].float(), at_risk[index].float())
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * min(1.0, 1.9 - 1.8 * update / config.updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        recent.append(loss.detach())
        if update % 50 == 49 or update == config.updates - 1:
            curve.append({"update": update + 1, "loss": float(torch.stack(recent).mean())})
            recent.clear()
            report((update + 1) / config.updates, f"update {update + 1}/{config.updates}, loss {curve[-1]['loss']:.3f}")
    model.eval().requires_grad_(False)
    return model, curve


@torch.inference_mode()
def foreseen(model: LookAhead, latents: Latents, ahead: Ahead) -> NDArray[np.float64]:
    """Return the probability [R, H] of any cost within 1..H decisions of each row, under the commands that were executed."""
    parts = []
    for part in torch.arange(len(ahead.rows)).split(CHUNK):
        here = part.numpy()
        seen = latents.at(torch.from_numpy(ahead.rows[here])).features
        parts.append(model(seen, torch.from_numpy(ahead.command[here])))
    found: NDArray[np.float64] = torch.cat(parts).double().numpy()
    return found


@torch.inference_mode()
def rolled_out(model: SafetyWorldModel, latents: Latents, ahead: Ahead, gamma: float, samples: int, seed: int) -> NDArray[np.float64]:
    """Return what the safety gate would read at each row [R, H]: the discounted sums over 1..H imagined costs under the executed commands.

    Args:
        model: the frozen world model.
        latents: of the recorded rows.
        ahead: the rows, and what was executed.
        gamma: gamma_c.
        samples: imagined futures that are averaged.
        seed: of them.
    """
    source, parts = generator(seed), []
    weights = gamma ** torch.arange(ahead.command.shape[1])
    for part in torch.arange(len(ahead.rows)).split(CHUNK):
        here = part.numpy()
        start, command = latents.at(torch.from_numpy(ahead.rows[here])), torch.from_numpy(ahead.command[here])
        total = torch.zeros(len(part), len(weights))
        for _ in range(samples):
            arrived = roll_prior(model, start, command, source)
            keep = model.continues(arrived)
            alive = torch.cat([torch.ones_like(keep[:, :1]), keep[:, :-1]], 1).cumprod(1)
            total += (weights * alive * model.cost(arrived)).cumsum(1) / samples
        parts.append(total)
    found: NDArray[np.float64] = torch.cat(parts).double().numpy()
    return found


def judged(recording: Recording, ahead: Ahead, head: NDArray[np.float64], summed: NDArray[np.float64]) -> dict[str, dict[str, Any]]:
    """Judge the look ahead by window: a row of numbers for each.

    `base` is the share of rows with a cost within the window, `auprc` that of the look ahead for it (`auprc_low`, `auprc_high`: a 95 %
    interval over resampled episodes), `sum_auprc` that of the world model's rolled-out sum over the same decisions. With `onset_` only
    rows count that do not cost themselves. `predicted_over_base`, `calibration_error` and `reliability` are about the look ahead alone.

    Args:
        recording: cost and episode of the recorded rows.
        ahead: R rows and what followed.
        head: [R, H] probabilities of any cost within 1..H decisions.
        summed: [R, H] sums of imagined costs over them.
    """
    found: dict[str, dict[str, Any]] = {}
    for window in [w for w in WINDOWS if w <= head.shape[1]] or [head.shape[1]]:
        event, known = ahead.any_within(window)
        event, score, other = event[known], head[known, window - 1], summed[known, window - 1]
        calm, episode = recording.cost[ahead.rows[known]] == 0, recording.episode[ahead.rows[known]]
        base, bins = _mean(event), reliability(event, score)
        low, high = average_precision_interval(event, score, episode)
        found[str(window)] = {
            "rows": len(event), "base": base, "auprc": average_precision(event, score), "auprc_low": low, "auprc_high": high,
            "sum_auprc": average_precision(event, other),
            "onset_base": _mean(event[calm]), "onset_auprc": average_precision(event[calm], score[calm]),
            "sum_onset_auprc": average_precision(event[calm], other[calm]),
            "predicted_over_base": _mean(score) / base if base else float("nan"),
            "calibration_error": calibration_error(bins), "reliability": [row._asdict() for row in bins],
        }  # fmt: skip
    return found


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else float("nan")
