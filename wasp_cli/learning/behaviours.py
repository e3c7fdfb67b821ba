"""Who drives the episodes of a dataset: a mixture of behaviours, so that unsafe and off-course
states are covered. B episodes side by side, K checkpoints, A components of an action.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.shards import HELD_OUT, held_out_period
from wasp_cli.models.policy import PrivilegedPolicy


@dataclass(frozen=True)
class Behaviour:
    """How the commands of one episode come about; probabilities are per decision."""

    name: str
    skill: int = -1  # index of the checkpoint whose policy intends the command
    gaussian: float = 0.0  # standard deviation of noise that is added to it
    replace: float = 0.0  # probability of a uniform command in its place
    repeat: float = 0.0  # probability that the last command is repeated
    delay: int = 0  # decisions between an observation and the command for it
    burst: float = 0.0  # probability that a random command begins, which is held for 2-11 decisions
    drift: float = 0.0
    """Constant that is added to the last component: the turning of the point, one wheel of the
    car.
    """
    sticky: float = 0.0  # standard deviation of noise that persists from decision to decision
    correlation: float = 0.9  # correlation of that noise between neighbouring decisions


def behaviours(
    mixture: dict[str, float], episodes: int, skills: int, random: np.random.Generator
) -> list[Behaviour]:
    """Draw a behaviour for each episode, in the shares of the mixture.

    The order is random, except that the episodes which `Recording.held_out` keeps from training
    have the shares of all. If they were left to chance, a behaviour could be missing among them, or
    one that always costs could outweigh the others.

    Args:
        mixture: share of each kind of behaviour; they sum to 1.
        episodes: length of the list.
        skills: number of checkpoints.
        random: of all draws.
    """
    variants: dict[str, list[Behaviour]] = {
        # Small mistakes, so that not only the expert's own way is recorded.
        "expert": [Behaviour("expert", gaussian=0.25)],
        "noisy": [Behaviour("noisy", replace=e) for e in (0.2, 0.4, 0.6)],
        "laggy": [Behaviour("laggy", repeat=p) for p in (0.5, 0.7, 0.85)],
        "delayed": [Behaviour("delayed", delay=d) for d in (2, 3, 5)],
        "early": [Behaviour("early", skill=k, gaussian=0.1) for k in range(min(2, skills))],
        "bursts": [Behaviour("bursts", burst=0.08)],
        "careless": [Behaviour("careless", repeat=p) for p in (0.9, 0.95)],
        "random": [Behaviour("random", replace=1.0)],
    }

    # -- episodes of each kind, by largest remainders: as close to the shares as integers can be
    exact = {name: share * episodes for name, share in mixture.items()}
    counts = {name: int(value) for name, value in exact.items()}
    missing = episodes - sum(counts.values())
    by_remainder = sorted(exact, key=lambda name: counts[name] - exact[name])
    for name in by_remainder[:missing]:
        counts[name] += 1

    # -- the variants of a kind in equal parts, in random order
    rows: list[Behaviour] = []
    for name, count in counts.items():
        of_kind = [variants[name][i % len(variants[name])] for i in range(count)]
        rows += [of_kind[i] for i in random.permutation(count)]

    # -- shuffle; `rows` is sorted by kind, so every period-th of them has the shares of all
    order = np.arange(len(rows))
    period = held_out_period(HELD_OUT)
    for first in range(period):
        order[first::period] = random.permutation(order[first::period])
    return [rows[i] for i in order]


class Commander:
    """Commands for B rows, each with its own behaviour."""

    def __init__(
        self,
        skills: Sequence[PrivilegedPolicy],
        rows: Sequence[Behaviour],
        action: int,
        random: np.random.Generator,
    ) -> None:
        """Begin an episode in every row.

        Args:
            skills: the K checkpoints, the expert last.
            rows: [B] behaviours.
            action: A.
            random: of all draws.
        """
        self._skills = skills
        self._rows = rows
        self._random = random
        self._last = np.zeros((len(rows), action), np.float32)
        self._held = np.zeros(len(rows), int)  # decisions for which a burst still lasts
        self._noise = np.zeros_like(self._last)  # the noise that persists, in unit variance
        self._intended: list[NDArray[np.float32]] = []  # [B, A] of every decision so far

    def command(self, privileged: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return commands [B, A] in [-1, 1] for privileged observations [B, P]."""
        rows = self._rows
        random = self._random

        # -- what each row intends, with its delay
        with torch.inference_mode():
            observation = torch.from_numpy(privileged)
            by_skill = np.stack([skill(observation).numpy() for skill in self._skills])  # [K, B, A]
        self._intended.append(by_skill[[row.skill for row in rows], np.arange(len(rows))])
        now = len(self._intended) - 1
        action = np.zeros_like(self._intended[now])
        for i, row in enumerate(rows):
            if now >= row.delay:
                action[i] = self._intended[now - row.delay][i]

        # -- noise: independent, persistent (a stationary first-order process with a standard
        # deviation of 1 from the first decision on), and a constant
        gaussian = np.array([row.gaussian for row in rows], np.float32)[:, None]
        action = action + gaussian * random.standard_normal(action.shape, np.float32)
        fresh = random.standard_normal(action.shape, np.float32)
        if now == 0:
            self._noise = fresh
        else:
            rho = np.array([row.correlation for row in rows], np.float32)[:, None]
            self._noise = rho * self._noise + (1 - rho**2) ** 0.5 * fresh
        sticky = np.array([row.sticky for row in rows], np.float32)[:, None]
        action = action + sticky * self._noise
        action[:, -1] += [row.drift for row in rows]

        # -- uniform commands, for one decision or for a burst of them
        uniform = random.uniform(-1, 1, action.shape).astype(np.float32)
        replaced = random.random(len(rows)) < [row.replace for row in rows]
        begins = (random.random(len(rows)) < [row.burst for row in rows]) & (self._held == 0)
        length = random.integers(2, 12, len(rows))
        repeats = (random.random(len(rows)) < [row.repeat for row in rows]) & (now > 0)
        self._held = np.where(begins, length, np.maximum(self._held - 1, 0))
        action = np.where((replaced | begins)[:, None], uniform, action)

        # -- the last command again, where a burst lasts or a lag repeats it
        stands = repeats | ((self._held > 0) & ~begins)
        action = np.where(stands[:, None], self._last, action).clip(-1, 1)
        self._last = action.astype(np.float32)
        return self._last
