"""The value of the expert at recorded rows: Q_r and Q_c by TD on recorded transitions, read at the
expert's action. N rows, B rows of a batch, H rows ahead, A components of an action.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from wasp_cli.learning.configs.latent import CriticsConfig
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.models.critics import ActionCritics
from wasp_cli.models.policy import Skills

TOGETHER = 4096  # rows that are evaluated together


class SegmentBatch(NamedTuple):
    """B segments of recorded rows, H rows long behind their first row."""

    rows: Tensor  # [B] in which they begin
    actions: Tensor  # [B, H, A] executed from there on
    values: Tensor  # [2, B, H + 1] Q_r and Q_c from the first row on
    counts: Tensor  # [B, H + 1] 1 where a value counts, else 0


def recorded_values(
    skills: Skills,
    recording: Recording,
    latents: Latents,
    config: CriticsConfig,
    returns: ReturnsConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[Tensor, list[dict[str, float]]]:
    """Evaluate the expert at every recorded row: Q(s, a) = x + gamma Q'(s', pi_E(s')), where x is
    the reward or the cost of the transition.

    Anybody may have driven the transition, because Q depends on the action. Only what follows it is
    the expert's, and that comes from Q'.

    Args:
        skills: their expert is evaluated.
        recording: action, reward, cost, terminal, first and episode of N rows; held-out rows are
            not learned.
        latents: of the N rows.
        config: sizes, updates and rates of Q.
        returns: discounts.
        seed: of all draws but the initial weights.
        report: called every 100 updates with the share that is done and a text.

    Returns:
        Q_r and Q_c [2, N] of the expert's action, NaN at held-out rows and where an episode ended
        by its task's own rule; and the curve, a row of mean losses per 100 updates.
    """
    # -- transitions: row i + 1 holds what was executed at the state of row i, and what came of it
    allowed = ~recording.held_out(HELD_OUT)
    windows = recording.window_starts(2)
    starts = torch.from_numpy(windows[allowed[windows]])
    action = torch.from_numpy(recording.action)
    terminal = torch.from_numpy(recording.terminal)
    signals = torch.stack([torch.from_numpy(recording.reward), torch.from_numpy(recording.cost)])
    gammas = torch.tensor([[returns.gamma_r], [returns.gamma_c]])

    def expert_actions(rows: Tensor) -> Tensor:
        """The expert's actions [A, K] at K rows."""
        actions: Tensor = skills.expert(latents.at(rows).features)
        return actions.T

    expert = _in_parts(len(allowed), expert_actions).T.contiguous()  # [N, A]

    # -- networks
    q = ActionCritics(latents.features, action.shape[1], config.hidden, config.bins, config.reach)
    slow = copy.deepcopy(q).requires_grad_(False)
    optimizer = torch.optim.Adam(q.parameters(), lr=config.q_learning_rate, fused=True)

    source = generator(seed)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    for update in range(config.q_updates):
        # -- sample transitions [B], and compute their targets [2, B]
        index = starts[torch.randint(len(starts), (config.q_batch,), generator=source)]
        then = index + 1
        with torch.no_grad():
            following = slow(latents.at(then).features, expert[then]) * (1 - terminal[then])
            target = signals[:, then] + gammas * following

        # -- update; the rate is constant for the first half, then falls to a tenth
        losses = q.losses(latents.at(index).features, action[then], target).mean(1)
        for group in optimizer.param_groups:
            group["lr"] = config.q_learning_rate * min(1.0, 1.9 - 1.8 * update / config.q_updates)
        optimizer.zero_grad(set_to_none=True)
        losses.sum().backward()
        optimizer.step()

        # -- let the slow copy follow
        with torch.no_grad():
            for target_weight, weight in zip(slow.parameters(), q.parameters(), strict=True):
                target_weight.lerp_(weight, config.q_slow)

        # -- curve
        recent.append(losses.detach())
        if update % 100 == 99 or update == config.q_updates - 1:
            loss_r, loss_c = torch.stack(recent).mean(0).tolist()
            recent.clear()
            curve.append({"update": update + 1, "q_loss_r": loss_r, "q_loss_c": loss_c})
            report(
                (update + 1) / config.q_updates,
                f"Q: update {update + 1}/{config.q_updates}, losses {loss_r:.3f}, {loss_c:.3f}",
            )

    def expert_values(rows: Tensor) -> Tensor:
        """Q [2, K] of the expert's actions at K rows."""
        values: Tensor = q(latents.at(rows).features, expert[rows])
        return values

    values = _in_parts(len(allowed), expert_values)
    undefined = torch.from_numpy(~allowed) | (terminal > 0)
    return values.masked_fill(undefined, torch.nan), curve


@torch.no_grad()
def _in_parts(count: int, function: Callable[[Tensor], Tensor]) -> Tensor:
    """Call a function of K rows that returns [..., K] on `TOGETHER` rows at a time, and join what
    it returns: [..., count].
    """
    parts = torch.arange(count).split(TOGETHER)
    return torch.cat([function(rows) for rows in parts], -1)


class Segments:
    """Recorded rows with up to H rows that followed in the same episode, as far as these have
    values.
    """

    def __init__(self, recording: Recording, values: Tensor, horizon: int) -> None:
        """Find the rows at which a segment may begin: rows with a value, followed by a row of the
        same episode with a value.

        Args:
            recording: action and episode of N rows.
            values: [2, N], NaN where a row has no value.
            horizon: H.
        """
        self._has_value = ~values.isnan().any(0)
        self._values = values.nan_to_num(0.0)  # a missing value has no weight
        self._episode = torch.from_numpy(recording.episode)
        self._action = torch.from_numpy(recording.action)
        self._ahead = torch.arange(horizon + 1)
        same_episode = self._episode[:-1] == self._episode[1:]
        is_start = same_episode & self._has_value[:-1] & self._has_value[1:]
        self._starts = is_start.nonzero().flatten()

    def sample(self, count: int, source: torch.Generator) -> SegmentBatch:
        """Draw `count` segments. A value counts up to the end of its episode, and up to the first
        row without a value.
        """
        start = self._starts[torch.randint(len(self._starts), (count,), generator=source)]
        ahead = start[:, None] + self._ahead  # [B, H + 1]
        rows = ahead.clamp(max=len(self._episode) - 1)
        same_episode = self._episode[rows] == self._episode[start][:, None]
        within = same_episode & (ahead < len(self._episode))
        counts = (within & self._has_value[rows]).float().cumprod(1)
        return SegmentBatch(start, self._action[rows[:, 1:]], self._values[:, rows], counts)
