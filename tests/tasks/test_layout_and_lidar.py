from __future__ import annotations

import numpy as np
import pytest

from wasp_cli.errors import TaskError
from wasp_cli.tasks.features import lidars
from wasp_cli.tasks.frames import to_body
from wasp_cli.tasks.layout import Streams, Thing, draw_goal, draw_layout, random_stream, square


def test_things_keep_their_distance():
    places = square(1.5)
    agent, goal = Thing("agent", 0.4, places), Thing("goal", 0.305, places)
    others = tuple(Thing(f"h{i}", 0.18, places) for i in range(8))
    for seed in range(30):
        layout = draw_layout(random_stream(seed), agent, goal, others)
        places = np.stack([layout.agent_xy, layout.goal_xy, *layout.others_xy])
        keepouts = np.array([thing.keepout for thing in (agent, goal, *others)])
        gaps = np.linalg.norm(places[:, None] - places[None], axis=2) - keepouts[:, None] - keepouts[None]
        assert gaps[~np.eye(len(places), dtype=bool)].min() >= 0.0
        assert (np.abs(places) <= (1.5 - keepouts)[:, None]).all()


def test_rectangles_are_chosen_by_their_free_area_as_numpy_chooses():
    thing = Thing("t", 0.5, ((0.0, 0.0, 4.0, 2.0), (10.0, 0.0, 12.0, 2.0)))
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


def test_body_frame():
    seen = to_body(np.array([[[1.0, 2.0]]]), np.array([[1.0, 1.0]]), np.array([np.pi / 2]))
    np.testing.assert_allclose(seen, [[[1.0, 0.0]]], atol=1e-15)


def test_lidars_of_several_kinds_are_those_of_each():
    points = np.random.default_rng(0).uniform(-2.5, 2.5, (3, 9, 2))
    together = lidars(points, [1, 3, 5])
    np.testing.assert_array_equal(together, np.concatenate([lidar(points[:, :1]), lidar(points[:, 1:4]), lidar(points[:, 4:])], axis=1))
