"""What environments of others draw of themselves for people, where that is asked for."""

from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.tasks import tides
from tests.tasks.lights import Lights, registered
from wasp_cli.tasks.base import Bools, Floats, VectorTask
from wasp_cli.tasks.declared import Declaration, declare
from wasp_cli.tasks.foreign import paying
from wasp_cli.tasks.foreign.processes import ProcessTask
from wasp_cli.tasks.foreign.task import GymTask
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.pictures import PICTURE, picture_of

SHAPE = (30, 50)


class Painted(Lights):
    """Draws its clock as a grey of its own, and counts how often."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}
    paintings = 0

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def render(self) -> Any:
        if self.render_mode is None:
            return None
        Painted.paintings += 1
        return np.full((*SHAPE, 3), 100 + self.clock, np.uint8)


class Broken(Painted):
    """Cannot draw itself, and only finds out when it is asked to."""

    def render(self) -> Any:
        raise gymnasium.error.DependencyNotInstalled("a library is not installed")


class Listed(Painted):
    """Draws something that is no image."""

    def render(self) -> Any:
        return [np.zeros((*SHAPE, 3), np.uint8)]


def asked(env: Any, batch: int = 2) -> VectorTask:
    task = GymTask(registered(env), batch, action_repeat=2, observe=("pixels", PICTURE))
    task.reset(range(batch))
    return task


def outcomes(task: VectorTask) -> list[tuple[Floats, Bools]]:
    found = []
    for _ in range(4):
        step = task.step(np.full((task.batch, 2), 0.5))
        found.append((step.reward.tolist(), step.cost.tolist()))
    return found


def test_a_row_is_drawn_as_it_is_now():
    task = asked(Painted)
    first = picture_of(task, 1)
    assert (first.shape, first.dtype) == ((*SHAPE, 3), np.uint8)
    assert np.unique(first).tolist() == [100]
    task.step(np.zeros((2, 2)))
    task.reset([5], np.array([True, False]))
    assert [np.unique(picture_of(task, row)).tolist() for row in (0, 1)] == [[100], [102]]


def test_nothing_is_drawn_unasked():
    Painted.paintings = 0
    task = GymTask(registered(Painted), 1, action_repeat=2)
    task.reset([0])
    task.step(np.zeros((1, 2)))
    assert picture_of(task) is None
    asked(Painted).step(np.zeros((2, 2)))
    assert Painted.paintings == 0


@pytest.mark.parametrize("env", [Lights, Broken, Listed])
def test_an_environment_that_cannot_draw_itself_goes_on_without(env):
    task = asked(env)
    assert picture_of(task) is None
    unasked = GymTask(registered(env), 2, action_repeat=2)
    unasked.reset(range(2))
    assert outcomes(task) == outcomes(unasked)
    assert picture_of(task) is None


def test_tasks_of_this_package_have_maps_instead():
    task = make_task("goal1", 1, observe=())
    task.reset([0])
    assert picture_of(task) is None


def test_rows_in_other_processes_are_drawn_there(monkeypatch):
    monkeypatch.setattr(paying, "DECISION_SECONDS", 0.0)
    monkeypatch.setattr(paying, "EPISODE_SECONDS", 0.0)
    here, there = (
        make_task(f"{tides.__name__}:Drawn-v0", 3, observe=("state", PICTURE), threads=threads)
        for threads in (1, 2)
    )
    assert isinstance(there, ProcessTask)
    for task in (here, there):
        task.reset([1, 2, 3])
        task.step(np.full((3, 2), 0.5))
    for row in range(3):
        np.testing.assert_array_equal(picture_of(here, row), picture_of(there, row))
    assert not np.array_equal(picture_of(there, 0), picture_of(there, 2))
    silent = make_task(f"{tides.__name__}:Drawn-v0", 2, observe=("state",), threads=2)
    silent.reset([1, 2])
    assert picture_of(silent, 1) is None


@pytest.mark.skipif(find_spec("pygame") is None, reason="Pendulum draws with pygame")
def test_pendulum_draws_itself_where_assistants_see_numbers():
    declare("swing", Declaration(id="Pendulum-v1", cost="terminated"))
    task = make_task("swing", 1, observe=("state", PICTURE))
    task.reset([0])
    first = picture_of(task)
    task.step(np.ones((1, 1)))
    then = picture_of(task)
    assert first.shape == then.shape == (500, 500, 3)
    assert (first != then).any()
