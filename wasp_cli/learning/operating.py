"""How the values of an assistant's knob meet the same held-out worlds: few episodes of each, then
more of those that may be chosen.

A race: in each round all values that are left drive the same next worlds; after it the better half
stays, as far as it may still help (`metrics.operating_point`), until the budget is used up. What
the operators alone do in these worlds is known before.
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
"""Worlds that a value drives before it leaves for not helping: one world shows no more than itself.
"""
CHANGED = 1e-6  # distance of two forces, as shares of each motor's largest, from which they differ

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
    effective: int  # decisions at which its force was


Run = Callable[[float | None, range], list[HeldOut]]
"""Drives some worlds at a value of the knob."""


@dataclass(frozen=True)
class Race:
    """What is known of the values in the end."""

    points: tuple[Point, ...]  # in the order of the values
    finalists: tuple[Point, ...]  # those of the last round: they drove the same worlds
    episodes: tuple[HeldOut, ...]

    @property
    def chosen(self) -> Point | None:
        """The operating point; None: the assistant is silent."""
        return chosen(self.finalists)

    @property
    def best(self) -> Point:
        """The first of the finalists by the rule, whether it helps or not."""
        return ranked(self.finalists)[0]


def drivers(operators: Mapping[str, Sequence[float]], count: int, seed: int) -> list[Driver]:
    """Return who drives in each of `count` worlds: in every block of as many worlds as there are
    variants each variant once, in an order that is drawn, and each of its severities equally often.
    """
    random = np.random.default_rng(seed)
    variants = sorted(operators)
    severities: dict[str, list[float]] = {variant: [] for variant in variants}
    found: list[Driver] = []
    while len(found) < count:
        for place in random.permutation(len(variants)):
            variant = variants[place]
            if not severities[variant]:
                order = random.permutation(len(operators[variant]))
                severities[variant] = [operators[variant][i] for i in order]
            found.append((variant, severities[variant].pop()))
    return found[:count]


def tried(values: Sequence[float], episodes: int) -> list[float]:
    """Return the values that drive at all: every one, or spread evenly as many as there are
    episodes.
    """
    if episodes >= len(values):
        return list(values)
    places = np.linspace(0, len(values) - 1, episodes + 2)[1:-1]
    return [values[round(place)] for place in places]


def worlds_of_a_round(values: int, episodes: int) -> int:
    """Return how many worlds each value drives in a round, so that the budget lasts until two are
    left.
    """
    sizes = [values]
    while sizes[-1] > 2:
        sizes.append(_half(sizes[-1]))
    return max(1, episodes // sum(sizes))


def race(values: Sequence[float | None], budget: int, run: Run, alone: Sequence[HeldOut]) -> Race:
    """Run the race, see the module.

    Args:
        values: of the knob, at most `budget` many.
        budget: episodes of all values together at most.
        alone: the operators alone, by world.
    """
    size = worlds_of_a_round(len(values), budget)
    spread_return = _spread([each.return_ for each in alone])
    spread_cost = _spread([each.cost for each in alone])
    driven: dict[float | None, list[HeldOut]] = {value: [] for value in values}
    finalists: list[Point] = []
    left = list(values)
    while left and budget >= size * len(left):
        for value in left:
            begun = len(driven[value])
            driven[value] += run(value, range(begun, begun + size))
        budget -= size * len(left)
        finalists = [point_of(driven[value], alone) for value in left]
        still = ranked(finalists)
        if finalists[0].episodes >= LEAST_WORLDS:
            still = contested(finalists, spread_return, spread_cost, len(left))
        left = [point.value for point in still[: _half(len(left))]]
    points = tuple(point_of(rows, alone) for rows in driven.values())
    episodes = tuple(row for rows in driven.values() for row in rows)
    return Race(points, tuple(finalists), episodes)


def point_of(rows: Sequence[HeldOut], alone: Sequence[HeldOut]) -> Point:
    """Return means over the episodes of a value, and of the operators alone in the same worlds."""
    beside = [alone[row.world] for row in rows]
    return Point(
        rows[0].value,
        len(rows),
        float(np.mean([row.return_ for row in rows])),
        float(np.mean([row.cost for row in rows])),
        sum(row.effective for row in rows) / sum(row.steps for row in rows),
        float(np.mean([row.return_ for row in beside])),
        float(np.mean([row.cost for row in beside])),
        _error([row.return_ - other.return_ for row, other in zip(rows, beside, strict=True)]),
        _error([row.cost - other.cost for row, other in zip(rows, beside, strict=True)]),
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
        """Yield the episodes of an assistant in some worlds: for every assistant and every value
        the same worlds, with the same mistakes of the same operators.
        """
        for some in batches(worlds.start, worlds.stop, SIDE_BY_SIDE):
            task = make_task(
                self.task,
                len(some),
                action_repeat=self.action_repeat,
                observe=self.observe,
                threads=self.threads,
            )
            context = OperatorContext(
                self.parts.skills.at, task.action_size, task.decision_seconds, self.informed
            )
            operator = self._operator(context, some).to(self.parts.device)
            layouts = [derive("operating-episode", self.task, self.seed, i) for i in some]
            own = [derive("operating-method", self.task, self.seed, i, method) for i in some]
            loop = run_episodes(task, self.parts.world_model, operator, build(), layouts, own)
            for i, episode in zip(some, trajectories(loop)[0], strict=True):
                variant, severity = self.drivers[i]
                yield HeldOut(
                    value,
                    i,
                    variant,
                    severity,
                    episode.steps,
                    float(episode.reward.sum()),
                    float(episode.cost_env.sum()),
                    int((episode.deviation > 0).sum()),
                    changed_forces(self.parts.motors, episode.a, episode.a_h),
                )

    def _operator(self, context: OperatorContext, some: range) -> MixedOperator:
        """Return one operator whose rows are the drivers of some worlds."""
        noise = EpisodeNoise([derive("operating-noise", self.task, self.seed, i) for i in some])
        different = list(dict.fromkeys(self.drivers[i] for i in some))
        operators = [
            build_operator(variant, severity, context, noise, len(some))
            for variant, severity in different
        ]
        mixed = MixedOperator(operators, noise, 0)
        for row, i in enumerate(some):
            mixed.choice[row] = different.index(self.drivers[i])
        return mixed


def changed_forces(motors: Motors, a: Any, a_h: Any) -> int:
    """Return at how many decisions the executed actions [T, A] are another force than the commands
    [T, A].
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
    """Write the episodes, and the operating point with all points.

    Args:
        knob: its `symbol`, what it `turns` and the `name` of that; empty: the assistant has none.
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
