"""What the entries of a privileged vector are about, and mirrored episodes: both against the tasks."""

from typing import Any

import numpy as np
import pytest

from wasp_cli.tasks.goal.appearance import TILE_SIDE
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.privileged_layout import LAYOUTS, privileged_groups, privileged_mirror
from wasp_cli.tasks.registry import TASKS


@pytest.mark.parametrize(
    ("name", "moved", "wanted"),
    [
        ("goal1", "goal", {"goal"}), ("goal1", "hazards", {"things"}), ("goal1-two", "goal", {"goal"}), ("goal1-two", "other", set()),
        ("race1", "goal", {"goal"}), ("race1", "hazards", {"things"}),
        ("formula1", "goal", {"goal"}), ("formula1", "bodies", {"things"}),
    ],
)  # fmt: skip
def test_groups_lie_where_the_task_writes_them(name, moved, wanted):
    """Another place of one thing changes the entries of its own group, and of no other."""
    task = make_task(name, 1, action_repeat=4, observe=("privileged",), threads=1)
    before = task.reset([3]).privileged
    snapshot = task.snapshot()
    snapshot[moved] = snapshot[moved].copy()
    snapshot[moved][..., :2] *= 0.5
    after = task.restore(snapshot).privileged
    groups = privileged_groups(name, task.privileged_size)
    del groups["all"]
    assert {group for group, part in groups.items() if not np.array_equal(before[:, part], after[:, part])} == wanted


def test_every_vector_is_known():
    assert set(TASKS) == set(LAYOUTS)


@pytest.mark.parametrize("name", ["goal1", "goal1-two", "goal2"])
def test_a_mirrored_vector_is_that_of_the_mirrored_episode(name):
    task, twin = (make_task(name, 6, action_repeat=4, observe=("privileged",), threads=1) for _ in range(2))
    task.reset(range(6))
    twin.reset(range(6))
    mirror = privileged_mirror(name)
    assert mirror is not None
    order, sign = mirror
    random = np.random.default_rng(0)
    for _ in range(4):
        seen, original = twin.restore(reflected(task.snapshot())).privileged, task.restore(task.snapshot()).privileged
        # Without what is measured over a step: speed and turn rate are not in a snapshot's observation.
        np.testing.assert_allclose(seen[:, 3:], (original[:, order] * sign)[:, 3:], atol=1e-5)
        assert np.abs(original[:, order] * sign - original).max() > 0.1
        action = random.uniform(-1, 1, (6, 2))
        step, other = task.step(action).observation.privileged, twin.step(action * [1, -1]).observation.privileged
        np.testing.assert_allclose(other[:, :3], (step[:, order] * sign)[:, :3], atol=0.02)


def test_tasks_of_others_are_judged_as_a_whole_and_have_no_mirror():
    assert privileged_groups("pkg:Own-v0", 12) == {"all": slice(0, 12)}
    assert privileged_mirror("pkg:Own-v0") is None
    assert list(privileged_groups("goal0", 7)) == ["all", "motion", "goal"], "there is nothing that costs"


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
