"""The race between the values of an assistant's knob, in held-out worlds: few episodes of every
value, then more of those that may be chosen.

In each round all values that are left drive the same next worlds. After the round the better half
stays, as far as it may still help (`metrics.operating_point`), until the budget is used up. The
operators alone have driven the same worlds before.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wasp_cli.learning.assistants import POINT_FILE
from wasp_cli.learning.closed_loop import batches, run_episodes
from wasp_cli.learning.evaluation import trajectories
from wasp_cli.methods.base import Assistant, Parts
from wasp_cli.metrics.operating_point import Point, chosen, contested, helps, ranked
from wasp_cli.operators.base import EpisodeNoise, OperatorContext, Policy, build_operator
from wasp_cli.operators.mixed import MixedOperator
from wasp_cli.seeds import derive
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.motors import Motors

EPISODES_FILE = "held_out.json"  # a row for each episode
ALONE = "alone"
"""The name under which a node reads the episodes of the operators alone."""
SIDE_BY_SIDE = 10  # worlds of one batch at most
LEAST_WORLDS = 3
"""Worlds that a value drives before it may leave the race for not helping: a single world shows
little.
"""
CHANGED = 1e-6  # distance above which two forces differ, in shares of each motor's largest force

Driver = tuple[str, float]  # operator variant and severity


@dataclass(frozen=True)
class HeldOut:
    """One episode in a held-out world."""

    value: float | None  # of the knob
    world: int
    operator: str
    severity: float
    steps: int  # decisions
    return_: float
    cost: float  # env steps that cost
    interventions: int  # decisions at which the command was changed
    effective: int  # decisions at which the force of the command was changed


Run = Callable[[float | None, range], list[HeldOut]]
"""Drives some worlds at a value of the knob."""


@dataclass(frozen=True)
class Race:
    """The result of a race."""

    points: tuple[Point, ...]  # of all values, in their order
    finalists: tuple[Point, ...]  # of the values in the last round, which drove the same worlds
    episodes: tuple[HeldOut, ...]

    @property
    def chosen(self) -> Point | None:
        """The operating point; None where no value helps, and the assistant is silent."""
        return chosen(self.finalists)

    @property
    def best(self) -> Point:
        """The first of the finalists by the rule, whether it helps or not."""
        return ranked(self.finalists)[0]


def drivers(operators: Mapping[str, Sequence[float]], count: int, seed: int) -> list[Driver]:
    """Return who drives in each of `count` worlds.

    In every block of as many worlds as there are variants each variant drives once, in random
    order, and its severities drive equally often.

    Args:
        operators: severities by operator variant.
        count: number of worlds.
        seed: of all draws.
    """
    random = np.random.default_rng(seed)
    variants = sorted(operators)
    left: dict[str, list[float]] = {variant: [] for variant in variants}
    rows: list[Driver] = []
    while len(rows) < count:
        for place in random.permutation(len(variants)):
            variant = variants[place]
            if not left[variant]:
                order = random.permutation(len(operators[variant]))
                left[variant] = [operators[variant][i] for i in order]
            rows.append((variant, left[variant].pop()))
    return rows[:count]


def spread_values(values: Sequence[float], episodes: int) -> list[float]:
    """Return the values that race: all, or where there are fewer episodes than values as many as
    there are episodes, evenly spread.
    """
    if episodes >= len(values):
        return list(values)
    places = np.linspace(0, len(values) - 1, episodes + 2)[1:-1]
    return [values[round(place)] for place in places]


def worlds_of_a_round(values: int, episodes: int) -> int:
    """Return how many worlds each value drives in a round, so that the budget lasts until two
    values are left.

    Args:
        values: number of values.
        episodes: budget of all values together.
    """
    sizes = [values]
    while sizes[-1] > 2:
        sizes.append(_half(sizes[-1]))
    return max(1, episodes // sum(sizes))


def race(values: Sequence[float | None], budget: int, run: Run, alone: Sequence[HeldOut]) -> Race:
    """Run the race, see the module.

    Args:
        values: of the knob, not more than `budget`.
        budget: most episodes of all values together.
        run: drives worlds at a value.
        alone: episodes of the operators alone, by world.
    """
    size = worlds_of_a_round(len(values), budget)
    spread_return = _spread([each.return_ for each in alone])
    spread_cost = _spread([each.cost for each in alone])
    driven: dict[float | None, list[HeldOut]] = {value: [] for value in values}
    finalists: list[Point] = []
    left = list(values)
    while left and budget >= size * len(left):
        # -- a round: the same next worlds for all values
        for value in left:
            first = len(driven[value])
            driven[value] += run(value, range(first, first + size))
        budget -= size * len(left)
        finalists = [point_of(driven[value], alone) for value in left]

        # -- the better half goes on, as far as it may still help
        candidates = ranked(finalists)
        if finalists[0].episodes >= LEAST_WORLDS:
            candidates = contested(finalists, spread_return, spread_cost, len(left))
        left = [point.value for point in candidates[: _half(len(left))]]
    points = tuple(point_of(rows, alone) for rows in driven.values())
    episodes = tuple(row for rows in driven.values() for row in rows)
    return Race(points, tuple(finalists), episodes)


def point_of(rows: Sequence[HeldOut], alone: Sequence[HeldOut]) -> Point:
    """Return the means over the episodes of a value, and over those of the operators alone in the
    same worlds.
    """
    alone_rows = [alone[row.world] for row in rows]
    return Point(
        rows[0].value,
        len(rows),
        float(np.mean([row.return_ for row in rows])),
        float(np.mean([row.cost for row in rows])),
        sum(row.effective for row in rows) / sum(row.steps for row in rows),
        float(np.mean([row.return_ for row in alone_rows])),
        float(np.mean([row.cost for row in alone_rows])),
        _error([row.return_ - other.return_ for row, other in zip(rows, alone_rows, strict=True)]),
        _error([row.cost - other.cost for row, other in zip(rows, alone_rows, strict=True)]),
    )


@dataclass(frozen=True)
class Worlds:
    """The held-out worlds of a training, and who drives in each."""

    task: str
    seed: int  # of the training
    action_repeat: int
    drivers: Sequence[Driver]
    parts: Parts
    informed: Callable[[float], Policy] | None
    observe: tuple[str, ...]
    threads: int

    def drive(
        self, build: Callable[[], Assistant], method: str, value: float | None, worlds: range
    ) -> Iterator[HeldOut]:
        """Yield the episodes of an assistant in some worlds. Every assistant and every value of its
        knob meets the same worlds and the same mistakes of the same operators.

        Args:
            build: builds the assistant, for each batch anew.
            method: its name, in the names of its random streams.
            value: of its knob.
            worlds: numbers of the worlds.
        """
        for batch in batches(worlds.start, worlds.stop, SIDE_BY_SIDE):
            # -- task and operators
            task = make_task(
                self.task,
                len(batch),
                action_repeat=self.action_repeat,
                observe=self.observe,
                threads=self.threads,
            )
            context = OperatorContext(
                self.parts.skills.at, task.action_size, task.decision_seconds, self.informed
            )
            operator = self._operator(context, batch).to(self.parts.device)

            # -- episodes
            layouts = [derive("operating-episode", self.task, self.seed, i) for i in batch]
            draws = [derive("operating-method", self.task, self.seed, i, method) for i in batch]
            loop = run_episodes(task, self.parts.world_model, operator, build(), layouts, draws)
            episodes, _ = trajectories(loop)
            for world, episode in zip(batch, episodes, strict=True):
                variant, severity = self.drivers[world]
                yield HeldOut(
                    value=value,
                    world=world,
                    operator=variant,
                    severity=severity,
                    steps=episode.steps,
                    return_=float(episode.reward.sum()),
                    cost=float(episode.cost_env.sum()),
                    interventions=int((episode.deviation > 0).sum()),
                    effective=changed_forces(self.parts.motors, episode.a, episode.a_h),
                )

    def _operator(self, context: OperatorContext, batch: range) -> MixedOperator:
        """Return one operator whose rows are the drivers of some worlds."""
        noise = EpisodeNoise([derive("operating-noise", self.task, self.seed, i) for i in batch])
        different = list(dict.fromkeys(self.drivers[i] for i in batch))
        operators = [
            build_operator(variant, severity, context, noise, len(batch))
            for variant, severity in different
        ]
        mixed = MixedOperator(operators, noise, 0)
        for row, world in enumerate(batch):
            mixed.choice[row] = different.index(self.drivers[world])
        return mixed


def changed_forces(motors: Motors, a: Any, a_h: Any) -> int:
    """Return at how many of T decisions the force of the executed action differs from that of the
    command.

    Args:
        motors: of the task.
        a: [T, A] executed actions.
        a_h: [T, A] commands.
    """
    distance = np.linalg.norm(motors.force(a) - motors.force(a_h), axis=1)
    return int((distance > CHANGED).sum())


def write_alone(folder: Path, episodes: Sequence[HeldOut]) -> None:
    """Write the episodes of the operators alone."""
    _write(folder / EPISODES_FILE, [asdict(row) for row in episodes])


def read_alone(folder: Path) -> list[HeldOut]:
    """Read the episodes of the operators alone, by world."""
    return [HeldOut(**row) for row in json.loads((folder / EPISODES_FILE).read_text())]


def write_race(folder: Path, method: str, knob: Mapping[str, Any], found: Race) -> None:
    """Write the episodes, and the operating point with the points of all values.

    Args:
        folder: where.
        method: the assistant.
        knob: its `symbol`, what it `turns` and the `name` of that; empty where the assistant has no
            knob.
        found: the race.
    """
    _write(folder / EPISODES_FILE, [asdict(row) for row in found.episodes])
    point = found.chosen
    document = {
        "method": method,
        "knob": dict(knob) or None,
        "silent": point is None,
        "value": None if point is None else point.value,
        "best": asdict(found.best),
        "points": [
            {**asdict(each), "helps": helps(each), "finalist": each in found.finalists}
            for each in found.points
        ],
    }
    _write(folder / POINT_FILE, document)


def _write(path: Path, document: Any) -> None:
    path.write_text(json.dumps(document, indent=1))


def _half(count: int) -> int:
    return (count + 1) // 2


def _error(differences: Sequence[float]) -> float:
    """Return the standard error of the mean of paired differences; 0 for a single one."""
    return _spread(differences) / math.sqrt(len(differences))


def _spread(numbers: Sequence[float]) -> float:
    return float(np.std(numbers, ddof=1)) if len(numbers) > 1 else 0.0
