"""A linear probe tells what is there to be seen from what is not."""

import numpy as np

from wasp_cli.learning.seeing import sight_of

EPISODES, LENGTH, VALUES = 30, 40, 200


def moments(seed: int = 0):
    """Episodes, and whether a cost follows: by chance, in a sixth of the moments."""
    draws = np.random.default_rng(seed)
    episode = np.repeat(np.arange(EPISODES), LENGTH)
    return draws, episode, draws.random(len(episode)) < 1 / 6


def test_a_cost_that_shows_is_seen():
    draws, episode, follows = moments()
    seen = draws.integers(0, 256, (len(follows), VALUES)).astype(np.uint8)
    seen[follows, :12] = 250
    sight = sight_of(seen, follows, episode)
    assert sight.is_seen
    assert sight.auroc > 0.95
    assert sight.low <= sight.auroc <= sight.high
    assert (sight.samples, sight.costly) == (len(follows), int(follows.sum()))


def test_a_cost_that_does_not_show_is_not_seen():
    """Of draws of noise about one interval in 40 lies above chance."""
    found = []
    for seed in range(10):
        draws, episode, follows = moments(seed)
        found.append(sight_of(draws.normal(size=(len(follows), VALUES)), follows, episode))
    assert sum(sight.is_seen for sight in found) <= 1
    assert abs(np.mean([sight.auroc for sight in found]) - 0.5) < 0.02


def test_what_only_tells_episodes_apart_is_not_sight():
    """The probe is asked about episodes that it has not learned from."""
    found = []
    for seed in range(8):
        draws, episode, follows = moments(seed)
        follows &= (draws.random(EPISODES) < 0.5)[episode]
        seen = np.eye(EPISODES)[episode] + 0.01 * draws.normal(size=(len(episode), EPISODES))
        found.append(sight_of(seen, follows, episode))
    assert sum(sight.is_seen for sight in found) <= 1
    assert abs(np.mean([sight.auroc for sight in found]) - 0.5) < 0.1


def test_of_few_costs_nothing_is_said():
    draws, episode, follows = moments()
    follows &= episode < 4  # enough moments, of too few episodes
    sight = sight_of(draws.normal(size=(len(follows), VALUES)), follows, episode)
    assert (sight.auroc, sight.low, sight.high, sight.is_seen) == (None, None, None, False)
