"""Layouts are drawn as the reference package draws them, and seeds name them."""

import numpy as np
import pytest

from wasp_cli.errors import TaskError
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
