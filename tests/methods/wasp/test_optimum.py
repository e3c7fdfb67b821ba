"""Worlds with a known answer: plans against an exhaustive search.

Dimension letters: H horizon, L residual steps, M rollouts, A action size.
"""

import heapq
import itertools
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
import scene_drives
import scene_worlds
import torch
from scene_worlds import Corridor, Fork, PointWorld
from torch import Tensor

from wasp_cli.methods.configs import PrintedConfig
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Situation
from wasp_cli.methods.wasp.outcome import Plan
from wasp_cli.methods.wasp.printed import Printed
from wasp_cli.models.base import Latent
from wasp_cli.operators.delayed import DelayedOperator

SMALL = {"probe": 64, "candidates": 64, "elites": 16, "feasible": 16, "iterations": 3}
Vector = tuple[float, ...]
Kind = type[Corridor] | type[Fork]

H, M, DELAY = 12, 2, 4
GAMMA_R, GAMMA_C, LAM = 0.97, 0.93, 0.8


class Start(NamedTuple):
    place: Vector
    speed: Vector
    queue: float  # forward command, of all that the driver has decided but not yet issued


BEYOND = 0.02


class Beyond:
    """V_r = 3 p_1, V_c = BEYOND p_1."""

    def value_r(self, latent: Latent) -> Tensor:
        return 3.0 * latent.h[..., 0]

    def value_c(self, latent: Latent) -> Tensor:
        return BEYOND * latent.h[..., 0]


class Case(NamedTuple):
    """A decision, with all numbers that the literal reading needs."""

    world: PointWorld
    config: PrintedConfig
    start: Start
    gusts: list[list[list[float]]]  # Gumbel draws [H][M][A]


def case(kind: Kind, start: Start, steps: int, **changes: object) -> Case:
    sizes = (
        SMALL | {"horizon": H, "residual_steps": steps, "rollouts": M, "initial_std": 0.5} | changes
    )
    gusts = np.random.default_rng(0).gumbel(size=(H, M, kind.action_size)).tolist()
    return Case(
        kind(jitter=0.02, dtype=torch.float64), scene_drives.settings(**sizes), start, gusts
    )


def plan(case: Case, seed: int) -> Plan:
    """The printed WASP's own answer, on the rollouts that the literal reading takes too."""
    world, actions = case.world, case.world.action_size
    operator = scene_worlds.driver(world, scene_worlds.careful(world), DELAY * scene_worlds.STEP)
    assert isinstance(operator, DelayedOperator)
    assert operator.delay == DELAY
    forward = torch.zeros(1, actions, dtype=torch.float64)
    forward[0, 0] = case.start.queue
    operator.memory = {"queue": forward.repeat(1, DELAY).view(1, DELAY, actions)}
    start = Situation(
        world.at((*case.start.place, *case.start.speed)),
        forward,
        operator,
        torch.zeros(1, dtype=torch.long),
    )
    draws = Draws(torch.tensor([case.gusts], dtype=torch.float64), torch.zeros(1, H, M, 0))
    printed = Printed(
        case.config,
        Imagination(world, Beyond(), scene_worlds.careful(world), GAMMA_R, GAMMA_C, LAM),
        {},
    )
    printed.reset(torch.ones(1, dtype=torch.bool), [seed])
    return printed.plan(start, printed.nominal(start, draws), draws, printed.noise.streams())


def clip(value: float) -> float:
    return min(1.0, max(-1.0, value))


def driven(world: PointWorld, place: Sequence[float], speed: Sequence[float]) -> list[float]:
    """The careful driver in plain numbers: full speed towards the goal, to a stand where the
    hazard is near ahead.
    """
    goal = world.goal.tolist()
    if isinstance(world, Corridor):
        blocked = place[0] <= world.low and world.low - place[0] < scene_worlds.SIGHT
        wanted = [math.copysign(1.0, goal[0] - place[0])]
    else:
        assert isinstance(world, Fork)
        length = math.dist(goal, place)
        wanted = [(g - p) / length for g, p in zip(goal, place, strict=True)]
        to = [c - p for c, p in zip(world.centre.tolist(), place, strict=True)]
        along, aside = wanted[0] * to[0] + wanted[1] * to[1], wanted[0] * to[1] - wanted[1] * to[0]
        gap = along - math.sqrt(max(0.0, world.radius**2 - aside**2))
        blocked = abs(aside) < world.radius and 0 <= gap < scene_worlds.SIGHT
    if blocked:
        wanted = [0.0] * len(wanted)
    return [clip(w + scene_worlds.GAIN * (w - v)) for w, v in zip(wanted, speed, strict=True)]


def cost_probability(world: PointWorld, place: Sequence[float]) -> float:
    if isinstance(world, Corridor):
        depth = min(place[0] - world.low, world.high - place[0])
    else:
        assert isinstance(world, Fork)
        depth = world.radius - math.dist(place, world.centre.tolist())
    return 1.0 / (1.0 + math.exp(-depth / scene_worlds.BLUR))


class Value(NamedTuple):
    reward: float  # G^(r), mean over M
    cost: float  # G^(c), mean over M
    effort: float

    def s_task(self, config: PrintedConfig) -> float:
        """Eq. 16, minus infinity where Eq. 14 does not hold."""
        return self.reward - config.alpha * self.effort if self.cost <= config.tau_c else -math.inf

    def s_safe(self, config: PrintedConfig) -> float:
        """Eq. 17"""
        return max(self.cost - config.tau_c, 0.0) + config.alpha * self.effort


Residuals = tuple[Vector, ...]  # [L][A]


def literal(case: Case, residuals: Residuals) -> Value:
    """Residuals by Eq. 7-8 and 13, rollout by rollout and step by step in plain numbers."""
    world, config = case.world, case.config
    goal, size = world.goal.tolist(), world.action_size
    total = [0.0, 0.0, 0.0]
    for m in range(M):
        place, speed = list(case.start.place), list(case.start.speed)
        ahead = [case.start.queue] + [0.0] * (size - 1)
        queue = [ahead] * DELAY
        rewards, costs, keeps, firsts, effort = [], [], [], [], 0.0
        for k in range(H):
            command = ahead
            if k > 0:
                queue = [*queue, driven(world, place, speed)]
                command, queue = queue[0], queue[1:]
            action = command
            if k < config.residual_steps:
                action = [clip(c + r) for c, r in zip(ahead, residuals[k], strict=True)]
                effort += sum(r**2 for r in residuals[k])
            before = math.dist(goal, place)
            for i in range(size):
                gust = (case.gusts[k][m][i] - 0.5772) * math.sqrt(6) / math.pi
                speed[i] += 0.1 * (action[i] - speed[i]) + 0.02 * gust
                place[i] += 0.1 * speed[i]
            after = math.dist(goal, place)
            rewards.append(10.0 * (before - after))
            costs.append(cost_probability(world, place))
            keeps.append(float(after > 0.15))
            firsts.append(place[0])
        g_r, g_c = 3.0 * firsts[-1], BEYOND * firsts[-1]
        for k in reversed(range(H)):
            g_r = rewards[k] + GAMMA_R * keeps[k] * ((1 - LAM) * 3.0 * firsts[k] + LAM * g_r)
            g_c = costs[k] + GAMMA_C * keeps[k] * ((1 - LAM) * BEYOND * firsts[k] + LAM * g_c)
        total = [old + new / M for old, new in zip(total, (g_r, g_c, effort), strict=True)]
    return Value(*total)


# values per element of a sequence in [-2, 2], by action size and residual steps
GRID = {1: {2: 33, 3: 17}, 2: {2: 9}}


def best(case: Case, score: Callable[[Value], float]) -> float:
    """The largest score over every sequence of a grid, then over ever closer neighbours of the
    five best of them.
    """
    steps, size = case.config.residual_steps, case.world.action_size

    def value(flat: Vector) -> tuple[float, Vector]:
        return score(
            literal(case, tuple(flat[i : i + size] for i in range(0, len(flat), size)))
        ), flat

    grid = np.linspace(-2, 2, GRID[size][steps]).tolist()
    reached = []
    for top in heapq.nlargest(
        5, (value(flat) for flat in itertools.product(grid, repeat=steps * size))
    ):
        change = (grid[1] - grid[0]) / 2
        while change > 0.02:
            moves = itertools.product((-change, 0.0, change), repeat=steps * size)
            found = max(
                value(tuple(min(2.0, max(-2.0, f + m)) for f, m in zip(top[1], move, strict=True)))
                for move in moves
            )
            if found[0] <= top[0] + 1e-3:
                change /= 2
            top = max(top, found)
        reached.append(top[0])
    return max(reached)


@cache
def optimum(kind: Kind, start: Start, steps: int) -> tuple[float, float]:
    """The largest S_task subject to Eq. 14 (minus infinity if nothing is feasible), and the
    smallest S_safe where nothing is.
    """
    asked = case(kind, start, steps)
    s_task = best(asked, lambda value: value.s_task(asked.config))
    return s_task, -best(
        asked, lambda value: -value.s_safe(asked.config)
    ) if s_task == -math.inf else math.nan


def of_plan(case: Case, seed: int) -> tuple[Plan, Value]:
    """The plan, and what the literal reading says of it."""
    found = plan(case, seed)
    value = literal(case, tuple(tuple(residual) for residual in found.residuals[0].tolist()))
    assert (float(found.reward), float(found.cost)) == pytest.approx(
        (value.reward, value.cost), abs=1e-9
    )
    return found, value


def slow(*values: object) -> object:
    return pytest.param(*values, marks=pytest.mark.slow)


ROOMY = [
    slow(Corridor, Start((0.2,), (0.3,), 1.0), 2),
    (Corridor, Start((1.0,), (0.8,), 1.0), 2),
    slow(Corridor, Start((1.1,), (0.7,), 1.0), 3),
    (Fork, Start((0.5, 0.0), (0.8, 0.0), 1.0), 2),
    slow(Fork, Start((1.3, 0.2), (0.1, 0.0), 0.0), 2),
]
"""Far from the hazard; moving towards it (the constraint decides, except in the first and the
last); standing beside it.
"""
TIGHT = [
    (Corridor, Start((1.4,), (0.8,), 1.0), 2),
    slow(Corridor, Start((1.4,), (0.9,), 1.0), 3),
    slow(Corridor, Start((1.5,), (0.8,), 1.0), 3),
    slow(Fork, Start((0.9, 0.0), (0.9, 0.0), 1.0), 2),
]
"""So near that at most ten of three hundred random sequences are safe, and in some draws none."""
TRAPPED = [
    (Corridor, Start((1.6,), (1.0,), 1.0), 2),
    slow(Corridor, Start((2.3,), (0.1,), 0.0), 2),
    slow(Fork, Start((1.7, 0.15), (0.2, 0.0), 1.0), 2),
]
"""Too fast to stop, or in the hazard."""
BETWEEN = 0.1
"""A plan may be better than the exhaustive search by what lies between its points; 0.1 is the
reward of a centimetre.
"""
PAPER = {"candidates": 300, "probe": 300, "elites": 100, "feasible": 100, "iterations": 6}
SIZES = [
    pytest.param(SMALL, 0.15, id="small"),
    pytest.param(PAPER, 0.05, id="paper", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("sizes", "tolerance"), SIZES)
@pytest.mark.parametrize(("kind", "start", "steps"), ROOMY)
def test_a_plan_is_as_good_as_an_exhaustive_search(kind, start, steps, sizes, tolerance):
    s_task, _ = optimum(kind, start, steps)
    for seed in range(4):
        asked = case(kind, start, steps, **sizes)
        _, value = of_plan(asked, seed)
        assert value.cost <= asked.config.tau_c
        assert s_task - tolerance <= value.s_task(asked.config) <= s_task + BETWEEN


@pytest.mark.parametrize(("kind", "start", "steps"), TIGHT)
def test_with_the_papers_sizes_a_plan_is_found_where_few_are_safe(kind, start, steps):
    s_task, _ = optimum(kind, start, steps)
    for seed in range(4):
        asked = case(kind, start, steps, **PAPER)
        found, value = of_plan(asked, seed)
        assert found.case2[0, 0]
        assert found.safe[0, 0] <= 20
        assert value.cost <= asked.config.tau_c
        # Of about 6: where two candidates in a hundred are safe, six iterations come this close and
        # no closer.
        assert s_task - 0.1 <= value.s_task(asked.config) <= s_task + BETWEEN


@pytest.mark.parametrize(("kind", "start", "steps"), TRAPPED)
def test_where_nothing_is_safe_a_plan_gains_most_of_what_can_be_gained(kind, start, steps):
    """By S_safe (Eq. 17), from doing nothing to the least of the exhaustive search."""
    s_task, s_safe = optimum(kind, start, steps)
    assert s_task == -math.inf
    for seed in range(4):
        asked = case(kind, start, steps, **PAPER)
        found, value = of_plan(asked, seed)
        nothing = literal(asked, ((0.0,) * kind.action_size,) * steps).s_safe(asked.config)
        assert found.case2.all()
        assert value.cost > asked.config.tau_c
        assert s_safe - 0.01 <= value.s_safe(asked.config) <= s_safe + 0.25 * (nothing - s_safe)
