"""Lidars by hand, rays and outlines against brute force, changes of frame."""

from typing import Any

import numpy as np
import pytest

from wasp_cli.errors import TaskError
from wasp_cli.tasks.features import RAYS, lidars, ray_distances
from wasp_cli.tasks.frames import (
    ground_to_body,
    quaternion_rotation,
    to_body,
    yaw_quaternion,
    yaw_rotation,
)
from wasp_cli.tasks.goal.appearance import TILE_SIDE
from wasp_cli.tasks.layout import (
    Rectangle,
    Streams,
    Thing,
    draw_goal,
    draw_layout,
    random_stream,
    square,
)
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.outline import distance_to_segments, inside, parse_outline, segments
from wasp_cli.tasks.privileged_layout import LAYOUTS, privileged_groups, privileged_mirror
from wasp_cli.tasks.registry import TASKS


def lidar(points: np.ndarray) -> np.ndarray:
    """Of objects of one kind."""
    return lidars(points, [points.shape[1]])


def test_lidar_of_one_object():
    width = 2 * np.pi / 16
    angle, distance = 2.25 * width, 1.5
    bins = lidar(distance * np.array([[[np.cos(angle), np.sin(angle)]]]))[0]
    np.testing.assert_allclose(bins[[1, 2, 3]], [0.75 * 0.5, 0.5, 0.25 * 0.5], atol=1e-12)
    assert np.count_nonzero(bins) == 3


def test_lidar_wraps_and_ends():
    just_below = lidar(np.array([[[1.0, -1e-17]]]))[0]
    assert just_below.max() == pytest.approx(2 / 3)
    assert lidar(np.array([[[3.0, 0.1]]])).max() == 0.0
    both = lidar(np.array([[[1.0, 0.01], [2.0, 0.01]]]))
    assert both[0, 0] == lidar(np.array([[[1.0, 0.01]]]))[0, 0]


def test_rays_against_marching():
    rng = np.random.default_rng(1)
    origin, heading = rng.uniform(-1.0, 1.0, (4, 2)), rng.uniform(-3.0, 3.0, 4)
    circles, sides = rng.uniform(-2.0, 2.0, (4, 6, 2)), segments(rng.uniform(-2.5, 2.5, (5, 2)))
    radius, limit = 0.25, 2.0
    found = ray_distances(origin, heading, circles, radius, sides, limit)
    assert found.shape == (4, RAYS)

    steps = np.arange(0.0, limit, 1e-3)
    for b in range(4):
        for k in range(RAYS):
            angle = heading[b] + 2 * np.pi * k / RAYS
            points = origin[b] + steps[:, None] * np.array([np.cos(angle), np.sin(angle)])
            in_circle = (np.linalg.norm(points[:, None] - circles[b], axis=2) < radius).any(axis=1)
            # A side is crossed between two points where it lies within half a step of one of them.
            on_side = (distance_to_segments(points, sides) < 6e-4).any(axis=1)
            hit = np.flatnonzero(in_circle | on_side)
            assert found[b, k] == pytest.approx(steps[hit[0]] if hit.size else limit, abs=4e-3)


SQUARE = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)])


def test_body_frame():
    seen = to_body(np.array([[[1.0, 2.0]]]), np.array([[1.0, 1.0]]), np.array([np.pi / 2]))
    np.testing.assert_allclose(seen, [[[1.0, 0.0]]], atol=1e-15)


def test_outlines_are_parsed_and_closed():
    assert parse_outline("1,2 3,4.5\n -5,6").tolist() == [[1.0, 2.0], [3.0, 4.5], [-5.0, 6.0]]
    sides = segments(SQUARE, SQUARE + 5.0)
    assert sides.shape == (8, 2, 2)
    assert sides[3].tolist() == [[0.0, 2.0], [0.0, 0.0]]


def test_distances_to_sides_against_dense_points():
    rng = np.random.default_rng(0)
    places, sides = rng.normal(size=(20, 2)), rng.normal(size=(15, 2, 2))
    share = np.linspace(0.0, 1.0, 2001)[:, None]
    dense = np.stack(
        [
            np.linalg.norm((1 - share) * a + share * b - places[:, None], axis=2).min(axis=1)
            for a, b in sides
        ],
        axis=1,
    )
    np.testing.assert_allclose(distance_to_segments(places, sides), dense, atol=2e-3)


def test_inside():
    places = np.array([(1.0, 1.0), (3.0, 1.0), (-0.1, 0.5), (1.999, 0.001)])
    assert inside(places, SQUARE).tolist() == [True, False, False, True]
    assert inside(places, SQUARE[::-1]).tolist() == [True, False, False, True]


def test_frames_agree():
    rng = np.random.default_rng(2)
    yaw = rng.uniform(-3.0, 3.0, 5)
    np.testing.assert_allclose(
        quaternion_rotation(yaw_quaternion(yaw)), yaw_rotation(yaw), atol=1e-15
    )
    points, xy = rng.normal(size=(5, 3, 2)), rng.normal(size=(5, 2))
    upright = np.concatenate([xy, np.full((5, 1), 0.1)], axis=1)
    np.testing.assert_allclose(
        ground_to_body(points, upright, yaw_rotation(yaw)), to_body(points, xy, yaw), atol=1e-15
    )


def test_tilted_bodies_see_the_ground_below():
    # A body that looks straight down along its x axis sees what is 1 m below it 1 m ahead.
    down = np.array([[[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]])
    np.testing.assert_allclose(
        ground_to_body(np.zeros((1, 1, 2)), np.array([[0.0, 0.0, 1.0]]), down),
        [[[1.0, 0.0]]],
        atol=1e-15,
    )


# Layouts are drawn as the reference package draws them, and seeds name them.


def test_things_keep_their_distance():
    places = square(1.5)
    agent, goal = Thing("agent", 0.4, places), Thing("goal", 0.305, places)
    others = tuple(Thing(f"h{i}", 0.18, places) for i in range(8))
    for seed in range(30):
        layout = draw_layout(random_stream(seed), agent, goal, others)
        places = np.stack([layout.agent_xy, layout.goal_xy, *layout.others_xy])
        keepouts = np.array([thing.keepout for thing in (agent, goal, *others)])
        gaps = (
            np.linalg.norm(places[:, None] - places[None], axis=2)
            - keepouts[:, None]
            - keepouts[None]
        )
        assert gaps[~np.eye(len(places), dtype=bool)].min() >= 0.0
        assert (np.abs(places) <= (1.5 - keepouts)[:, None]).all()


def test_rectangles_are_chosen_by_their_free_area_as_numpy_chooses():
    thing = Thing("t", 0.5, (Rectangle(0.0, 0.0, 4.0, 2.0), Rectangle(10.0, 0.0, 12.0, 2.0)))
    assert thing.shares.tolist() == [0.75, 1.0]
    ours, numpys = random_stream(3), random_stream(3)
    for _ in range(50):
        place = draw_goal(ours, thing, (), np.zeros((0, 2)))
        x0, y0, x1, y1 = thing.free[numpys.choice(2, p=[0.75, 0.25])]
        assert place.tolist() == [numpys.uniform(x0, x1), numpys.uniform(y0, y1)]


def test_a_crowded_square_is_an_error_and_a_crowded_goal_is_none(monkeypatch):
    monkeypatch.setattr("wasp_cli.tasks.layout.TRIES_PER_LAYOUT", 5)
    big = Thing("big", 1.4, square(1.5))
    with pytest.raises(TaskError, match="no layout found"):
        draw_layout(random_stream(0), big, big, (big,))
    assert draw_goal(random_stream(0), big, (big,), np.zeros((1, 2))) is None


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_seeds_out_of_range(seed):
    with pytest.raises(TaskError, match="out of range"):
        random_stream(seed)


def test_owed_draws_are_the_draws_of_each_step():
    streams, plain = Streams(2), random_stream(5)
    streams.start(1, 5)
    for _ in range(7):
        streams.count_step(np.array([1]))
        plain.random_sample()
    kept = streams.snapshot()
    expected = plain.random_sample()
    assert streams.catch_up(1).random_sample() == expected
    streams.restore(kept["stream_key"], kept["stream_position"], kept["stream_owed"])
    assert streams.catch_up(1).random_sample() == expected


# What the entries of a privileged vector are about, and mirrored episodes: both against the tasks.


@pytest.mark.parametrize(
    ("name", "moved", "wanted"),
    [
        ("goal1", "goal", {"goal"}),
        ("goal1", "hazards", {"things"}),
        ("goal1-two", "goal", {"goal"}),
        ("goal1-two", "other", set()),
        ("race1", "goal", {"goal"}),
        ("race1", "hazards", {"things"}),
        ("formula1", "goal", {"goal"}),
        ("formula1", "bodies", {"things"}),
    ],
)
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
    assert {
        group
        for group, part in groups.items()
        if not np.array_equal(before[:, part], after[:, part])
    } == wanted


def test_every_vector_is_known():
    assert set(TASKS) == set(LAYOUTS)


@pytest.mark.parametrize("name", ["goal1", "goal1-two", "goal2"])
def test_a_mirrored_vector_is_that_of_the_mirrored_episode(name):
    task, twin = (
        make_task(name, 6, action_repeat=4, observe=("privileged",), threads=1) for _ in range(2)
    )
    task.reset(range(6))
    twin.reset(range(6))
    order, sign = privileged_mirror(name)
    random = np.random.default_rng(0)
    for _ in range(4):
        seen, original = (
            twin.restore(reflected(task.snapshot())).privileged,
            task.restore(task.snapshot()).privileged,
        )
        # Without what is measured over a step: speed and turn rate are not in a snapshot's
        # observation.
        np.testing.assert_allclose(seen[:, 3:], (original[:, order] * sign)[:, 3:], atol=1e-5)
        assert np.abs(original[:, order] * sign - original).max() > 0.1
        action = random.uniform(-1, 1, (6, 2))
        step, other = (
            task.step(action).observation.privileged,
            twin.step(action * [1, -1]).observation.privileged,
        )
        np.testing.assert_allclose(other[:, :3], (step[:, order] * sign)[:, :3], atol=0.02)


def test_tasks_of_others_are_judged_as_a_whole_and_have_no_mirror():
    assert privileged_groups("pkg:Own-v0", 12) == {"all": slice(0, 12)}
    assert privileged_mirror("pkg:Own-v0") is None
    assert list(privileged_groups("goal0", 7)) == ["all", "motion", "goal"], (
        "there is nothing that costs"
    )


EPISODES = 8


def reflected(snapshot: dict[str, np.ndarray[Any, Any]]) -> dict[str, np.ndarray[Any, Any]]:
    """Left and right exchanged, about a line in the middle of a row of floor tiles: the floor
    stays what it is.
    """
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
