"""Data collection: a mixture of behaviours, so that unsafe and off-course states are covered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.shards import HELD_OUT, Recording, held_out_period
from wasp_cli.models.policy import PrivilegedPolicy
from wasp_cli.tasks.base import Observation, VectorTask


@dataclass(frozen=True)
class Behaviour:
    """How one episode's commands come about; probabilities are per decision step."""

    name: str
    skill: int = -1  # index of the checkpoint whose policy intends the command
    gaussian: float = 0.0  # standard deviation added to it
    replace: float = 0.0  # probability of a uniform command instead
    repeat: float = 0.0  # probability of the last command again
    delay: int = 0  # decision steps between what is seen and the command for it
    burst: float = 0.0  # probability that a random command begins and is held for 2-11 steps
    # constant that is added to the last component: the turning of the point, one wheel of the car
    drift: float = 0.0
    sticky: float = 0.0  # standard deviation of noise that persists from step to step
    correlation: float = 0.9  # correlation of that noise between one decision step and the next


def behaviours(
    mixture: dict[str, float], episodes: int, skills: int, random: np.random.Generator
) -> list[Behaviour]:
    """Draw a behaviour for each episode, in the shares of the mixture; `skills` is the number of
    checkpoints.

    The order is random, except that the episodes which `Recording.held_out` keeps from training
    have the shares of all: left to chance, a behaviour may be missing among them, or one that
    always costs may outweigh the others.
    """
    variants: dict[str, list[Behaviour]] = {
        # small mistakes, so as not to see its own way alone
        "expert": [Behaviour("expert", gaussian=0.25)],
        "noisy": [Behaviour("noisy", replace=e) for e in (0.2, 0.4, 0.6)],
        "laggy": [Behaviour("laggy", repeat=p) for p in (0.5, 0.7, 0.85)],
        "delayed": [Behaviour("delayed", delay=d) for d in (2, 3, 5)],
        "early": [Behaviour("early", skill=k, gaussian=0.1) for k in range(min(2, skills))],
        "bursts": [Behaviour("bursts", burst=0.08)],
        "careless": [Behaviour("careless", repeat=p) for p in (0.9, 0.95)],
        "random": [Behaviour("random", replace=1.0)],
    }
    # Largest remainders: the counts follow the shares as closely as whole episodes can.
    exact = {name: share * episodes for name, share in mixture.items()}
    counts = {name: int(value) for name, value in exact.items()}
    for name in sorted(exact, key=lambda n: counts[n] - exact[n])[
        : episodes - sum(counts.values())
    ]:
        counts[name] += 1
    chosen = []
    for name, count in counts.items():
        own = [variants[name][i % len(variants[name])] for i in range(count)]
        chosen += [own[i] for i in random.permutation(count)]
    order, period = np.arange(len(chosen)), held_out_period(HELD_OUT)
    # every period-th of `chosen`, which is sorted by behaviour, has its shares
    for first in range(period):
        order[first::period] = random.permutation(order[first::period])
    return [chosen[i] for i in order]


class Commander:
    """Commands for B rows, each with its own behaviour."""

    def __init__(
        self,
        skills: Sequence[PrivilegedPolicy],
        rows: Sequence[Behaviour],
        action: int,
        random: np.random.Generator,
    ) -> None:
        self._skills, self._rows, self._random = skills, rows, random
        self._last = np.zeros((len(rows), action), np.float32)
        self._held = np.zeros(len(rows), int)
        self._noise = np.zeros_like(self._last)
        self._seen: list[NDArray[np.float32]] = []  # intended commands [B, A] of the episode so far

    def command(self, privileged: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return commands [B, A] in [-1, 1] for privileged observations [B, P]."""
        rows, random = self._rows, self._random
        with torch.inference_mode():
            seen = torch.from_numpy(privileged)
            intended = np.stack([skill(seen).numpy() for skill in self._skills])  # [K, B, A]
        self._seen.append(intended[[b.skill for b in rows], np.arange(len(rows))])
        now = len(self._seen) - 1
        neutral = np.zeros_like(self._last[0])
        action = np.stack(
            [
                self._seen[now - b.delay][i] if now >= b.delay else neutral
                for i, b in enumerate(rows)
            ]
        )
        action = action + np.array([b.gaussian for b in rows], np.float32)[
            :, None
        ] * random.standard_normal(action.shape, np.float32)
        fresh = random.standard_normal(action.shape, np.float32)
        # A stationary first-order process: its standard deviation is 1 from the first step on.
        kept = np.array([b.correlation for b in rows], np.float32)[:, None]
        self._noise = fresh if now == 0 else kept * self._noise + (1 - kept**2) ** 0.5 * fresh
        action = action + np.array([b.sticky for b in rows], np.float32)[:, None] * self._noise
        action[:, -1] += [b.drift for b in rows]
        uniform = random.uniform(-1, 1, action.shape).astype(np.float32)
        replaced = random.random(len(rows)) < [b.replace for b in rows]
        begins = (random.random(len(rows)) < [b.burst for b in rows]) & (self._held == 0)
        length = random.integers(2, 12, len(rows))
        repeats = (random.random(len(rows)) < [b.repeat for b in rows]) & (now > 0)
        self._held = np.where(begins, length, np.maximum(self._held - 1, 0))
        action = np.where((replaced | begins)[:, None], uniform, action)
        # While a burst is held, and where a lag repeats, the last command stands.
        action = np.where(
            (repeats | ((self._held > 0) & ~begins))[:, None], self._last, action
        ).clip(-1, 1)
        self._last = action.astype(np.float32)
        return self._last


def record(
    task: VectorTask,
    seeds: Sequence[int],
    command: Callable[[NDArray[np.float32]], NDArray[Any]],
    names: Sequence[str],
    number: int,
) -> Recording:
    """Record one episode per row as a shard.

    Args:
        task: B episodes with privileged observations and what assistants see: pixels, or the
            state where the task shows no image.
        command: from privileged observations [B, P] to actions [B, A].
        names: behaviour of each row.
        number: index of the first episode in the dataset.
    """
    seen = task.reset(seeds)
    batch, kinds = task.batch, task.cost_sources
    assert seen.privileged is not None
    zeros = np.zeros(batch, np.float32)
    steps: list[dict[str, NDArray[Any]]] = [
        {
            **_shown(seen),
            "action": np.zeros((batch, task.action_size), np.float32),
            "reward": zeros,
            "cost": zeros,
            "cost_env": zeros,
            "sources": np.zeros((batch, len(kinds)), np.int16),
            "goals": np.zeros(batch, np.int16),
            "terminal": zeros,
            "first": zeros + 1,
            "privileged": seen.privileged,
        }
    ]
    alive = [np.ones(batch, bool)]
    ended = np.zeros(batch, bool)
    for _ in range(task.max_decisions):
        assert seen.privileged is not None
        action = command(seen.privileged)
        step = task.step(action)
        seen = step.observation
        assert seen.privileged is not None
        costs = [step.sources[kind].astype(np.int16) for kind in kinds]
        steps.append(
            {
                **_shown(seen),
                "action": action,
                "reward": step.reward.astype(np.float32),
                "cost": step.cost.astype(np.float32),
                "cost_env": step.cost_env.astype(np.float32),
                "sources": np.stack(costs, 1) if costs else np.zeros((batch, 0), np.int16),
                "goals": step.goals.astype(np.int16),
                "terminal": (step.terminated & ~ended).astype(np.float32),
                "first": zeros,
                "privileged": seen.privileged,
            }
        )
        alive.append(~ended)
        ended = ended | step.ended
        if ended.all():
            break
    kept = np.stack(alive, 1)  # [B, T + 1]
    lengths = kept.sum(1)
    # Field by field, each taken out of the steps on the way, so that the images of a shard are in
    # memory at most twice.
    flat = {name: np.stack([s.pop(name) for s in steps], 1)[kept] for name in list(steps[0])}
    flat.setdefault("pixels", np.zeros(0, np.uint8))
    return Recording(
        episode=np.repeat(np.arange(number, number + batch, dtype=np.int32), lengths),
        behaviour=np.repeat(np.array(list(names), dtype=object), lengths),
        **flat,
    )


def _shown(seen: Observation) -> dict[str, NDArray[Any]]:
    """The column of what assistants see."""
    if seen.pixels is not None:
        return {"pixels": seen.pixels}
    assert seen.state is not None
    return {"state": seen.state.astype(np.float32)}
