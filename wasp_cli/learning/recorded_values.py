"""What the expert is worth at recorded rows: Q_r and Q_c by TD on recorded transitions, read at
the expert's action.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from torch import Tensor

from wasp_cli.learning.configs.latent import CriticsConfig
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.models.critics import ActionCritics
from wasp_cli.models.policy import Skills

AT_ONCE = 4096  # rows that are evaluated together


def recorded_values(
    skills: Skills,
    recording: Recording,
    latents: Latents,
    config: CriticsConfig,
    returns: ReturnsConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[Tensor, list[dict[str, float]]]:
    """Evaluate the expert at every recorded row from what was recorded, whoever drove: Q(s, a) = x
    + gamma Q'(s', pi_E(s')).

    The transition need not be the expert's, since Q is told the action: only what follows it is the
    expert's, and that is read from Q'.

    Args:
        recording: action, reward, cost, terminal, first and episode of N rows.

    Returns:
        Q_r and Q_c [2, N] of the expert's action, and a row of the curve per 100 updates: mean
        losses. NaN where there is no value to
        learn from: at held-out rows, and where an episode ended by itself.
    """
    allowed = ~recording.held_out(HELD_OUT)
    windows = recording.window_starts(2)
    starts = torch.from_numpy(windows[allowed[windows]])
    action, terminal = torch.from_numpy(recording.action), torch.from_numpy(recording.terminal)
    signals = torch.stack([torch.from_numpy(recording.reward), torch.from_numpy(recording.cost)])
    gammas = torch.tensor([[returns.gamma_r], [returns.gamma_c]])
    # [N, A]
    expert = _by_part(
        len(allowed), lambda rows: skills.expert(latents.at(rows).features).T
    ).T.contiguous()
    features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
    q = ActionCritics(features, action.shape[1], config.hidden, config.bins, config.reach)
    slow = copy.deepcopy(q).requires_grad_(False)
    optimizer = torch.optim.Adam(q.parameters(), lr=config.q_learning_rate, fused=True)
    source = generator(seed)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    for update in range(config.q_updates):
        index = starts[torch.randint(len(starts), (config.q_batch,), generator=source)]
        with torch.no_grad():
            following = slow(latents.at(index + 1).features, expert[index + 1]) * (
                1 - terminal[index + 1]
            )
            target = signals[:, index + 1] + gammas * following  # [2, B]
        losses = q.losses(latents.at(index).features, action[index + 1], target).mean(1)
        for group in optimizer.param_groups:
            group["lr"] = config.q_learning_rate * min(1.0, 1.9 - 1.8 * update / config.q_updates)
        optimizer.zero_grad(set_to_none=True)
        losses.sum().backward()
        optimizer.step()
        with torch.no_grad():
            for old, new in zip(slow.parameters(), q.parameters(), strict=True):
                old.lerp_(new, config.q_slow)
            recent.append(losses.detach())
        if update % 100 == 99 or update == config.q_updates - 1:
            loss_r, loss_c = torch.stack(recent).mean(0).tolist()
            recent.clear()
            curve.append({"update": update + 1, "q_loss_r": loss_r, "q_loss_c": loss_c})
            report(
                (update + 1) / config.q_updates,
                f"Q: update {update + 1}/{config.q_updates}, losses {loss_r:.3f}, {loss_c:.3f}",
            )
    values = _by_part(len(allowed), lambda rows: q(latents.at(rows).features, expert[rows]))
    unknown = torch.from_numpy(~allowed) | (terminal > 0)
    return values.masked_fill(unknown, torch.nan), curve


@torch.no_grad()
def _by_part(count: int, of: Callable[[Tensor], Tensor]) -> Tensor:
    """Join what a function of rows [K] returns [..., K], over all of them."""
    return torch.cat([of(rows) for rows in torch.arange(count).split(AT_ONCE)], -1)


class Segments:
    """Recorded rows with up to H rows that followed in the same episode, as far as their values
    are known.
    """

    def __init__(self, recording: Recording, values: Tensor, horizon: int) -> None:
        """Take rows that have a value and a following row of the same episode that has one.

        Args:
            recording: action and episode of N rows.
            values: [2, N], NaN where unknown.
        """
        self._known = ~values.isnan().any(0)
        self._values = values.nan_to_num(0.0)  # what is unknown has no weight
        self._episode, self._action = (
            torch.from_numpy(recording.episode),
            torch.from_numpy(recording.action),
        )
        self._ahead = torch.arange(horizon + 1)
        goes_on = (self._episode[:-1] == self._episode[1:]) & self._known[:-1] & self._known[1:]
        self._starts = goes_on.nonzero().flatten()

    def sample(self, count: int, source: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draw B segments.

        Returns:
            Rows [B] in which they begin, the actions [B, H, A] executed from there, values [2, B, H
            + 1] from the first row on, and whether each of these counts [B, H + 1].
        """
        start = self._starts[torch.randint(len(self._starts), (count,), generator=source)]
        rows = (start[:, None] + self._ahead).clamp(max=len(self._episode) - 1)
        within = (self._episode[rows] == self._episode[start][:, None]) & (
            start[:, None] + self._ahead < len(self._episode)
        )
        counts = (within & self._known[rows]).float().cumprod(1)
        return start, self._action[rows[:, 1:]], self._values[:, rows], counts
