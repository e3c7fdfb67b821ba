"""A mirrored episode is another possible one: the same images turned over, the same rewards and costs."""

from typing import Any

import numpy as np
import pytest

from wasp_cli.tasks.goal.appearance import TILE_SIDE
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS

EPISODES = 8


def reflected(snapshot: dict[str, np.ndarray[Any, Any]]) -> dict[str, np.ndarray[Any, Any]]:
    """Left and right exchanged, about a line in the middle of a row of floor tiles: the floor stays what it is."""
    other = {name: array.copy() for name, array in snapshot.items()}
    for name in {"goal", "other", "hazards", "bodies", "qpos"} & other.keys():
        other[name][..., 1] = TILE_SIDE - other[name][..., 1]
    other["qpos"][:, 2] *= -1
    other["qvel"][:, 1:] *= -1
    other["bodies"][..., [4, 6]] *= -1  # of a quaternion w, x, y, z the parts about x and z
    other["speeds"][..., [1, 3, 5]] *= -1
    other["control"][:, 1] *= -1
    return other


@pytest.mark.parametrize("name", ["goal1", "goal1-two"])
def test_a_mirrored_episode_is_seen_paid_and_punished_like_its_original(name):
    matrix = np.array(TASKS[name].mirror)
    task = make_task(name, EPISODES, action_repeat=4, observe=("pixels",))
    twin = make_task(name, EPISODES, action_repeat=4, observe=("pixels",))
    task.reset(range(EPISODES))
    twin.reset(range(EPISODES))
    random = np.random.default_rng(0)
    costs = compared = 0
    for t in range(60):
        if t % 10 == 0:  # motion is chaotic, so that the two would drift apart
            seen = twin.restore(reflected(task.snapshot()))
            original = task.restore(task.snapshot())
            same = np.ones(EPISODES, bool)  # a goal that is drawn anew is not drawn in a mirror
            off = np.abs(seen.pixels.astype(int) - original.pixels[..., ::-1].astype(int))
            assert (off > 2).mean() < 0.002
        action = random.uniform(-1, 1, (EPISODES, 2))
        step, other = task.step(action), twin.step(action @ matrix.T)
        if t % 10 < 3:
            same &= step.goals == 0
            np.testing.assert_allclose(other.reward[same], step.reward[same], atol=2e-3)
            np.testing.assert_array_equal(other.cost, step.cost)
            compared += int(same.sum())
            costs += int(step.cost.sum())
    assert costs > 0
    assert compared > 0.9 * 18 * EPISODES


@pytest.mark.parametrize("name", list(TASKS))
def test_only_tasks_without_a_map_have_a_mirror(name):
    info = TASKS[name]
    assert (info.mirror is not None) == name.startswith("goal")
    if info.mirror is not None:
        matrix = np.array(info.mirror)
        np.testing.assert_array_equal(matrix @ matrix, np.eye(len(matrix)))
