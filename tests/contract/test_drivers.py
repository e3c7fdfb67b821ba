"""Every cost source of every task can be reached by a scripted driver, from an ordinary start
and through actions alone.
"""

from collections.abc import Callable

import numpy as np
import pytest

from tests.driver import drive
from wasp_cli.tasks.formula.track import SIDES as BARRIERS
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.navigation import Navigation
from wasp_cli.tasks.race.task import SIDES as SCENERY
from wasp_cli.tasks.registry import TASKS

BATCH = 4


def nearest(points: np.ndarray, xy: np.ndarray) -> np.ndarray:
    apart = np.linalg.norm(points - xy[:, None], axis=2)
    return points[np.arange(len(points)), apart.argmin(axis=1)]


def hazards(task: Navigation) -> np.ndarray:
    return nearest(task.snapshot()["hazards"], task.pose()[0])


def vases(task: Navigation) -> np.ndarray:
    return nearest(task.snapshot()["bodies"][..., :2], task.pose()[0])


def walls(task: Navigation) -> np.ndarray:
    sides = BARRIERS if task.name == "formula" else SCENERY
    xy = task.pose()[0]
    return nearest(np.broadcast_to(sides.mean(axis=1), (len(xy), len(sides), 2)), xy)


TARGETS: dict[str, Callable[[Navigation], np.ndarray]] = {
    "hazards": hazards,
    "vases_contact": vases,
    "vases_velocity": vases,
    "static_geoms_contact": walls,
}

CASES = [(name, source) for name in TASKS for source in make_task(name, 1, observe=()).cost_sources]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "source"), CASES)
def test_a_cost_source_can_be_reached(name, source):
    task = make_task(name, BATCH, observe=())
    task.reset(range(BATCH))
    counts = np.zeros(BATCH, int)
    for _ in range(60):
        step = task.step(drive(task, TARGETS[source](task)))
        counts += step.sources[source]
        others = [count for other, count in step.sources.items() if other != source]
        assert (step.cost_env >= step.sources[source]).all()
        assert (step.cost_env <= sum(others, step.sources[source])).all()
        if step.ended.all():
            break
    assert (counts > 0).mean() >= 0.5


@pytest.mark.parametrize("name", ["goal1", "race1", "formula0"])
def test_the_route_earns_reward(name):
    task, idle = make_task(name, BATCH, observe=()), make_task(name, BATCH, observe=())
    earned = np.zeros(BATCH)
    for each in (task, idle):
        each.reset(range(BATCH))
    for _ in range(60):
        step = task.step(drive(task))
        earned += step.reward - idle.step(np.zeros((BATCH, 2))).reward
        if step.ended.all():
            break
    # Formula One's track leads away from some stages at first.
    assert np.median(earned) > 0.5
