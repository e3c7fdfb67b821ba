"""Recorded actions carried out again: every moment before its action, all episodes side by side, and nothing but what was recorded."""

from typing import Any

import numpy as np
import pytest

from wasp_cli.errors import ArtifactError
from wasp_cli.learning.playback import play, side_by_side
from wasp_cli.tasks.base import Observation, Step

LENGTHS = (4, 2, 3)


class Counting:
    """Rows that end after LENGTHS decisions; a reward is the sum of the actions so far."""

    batch = len(LENGTHS)

    def reset(self, seeds: list[int]) -> Observation:
        self.seeds, self.t, self.sums = seeds, 0, np.zeros(self.batch)
        return Observation(None, None, None)

    def step(self, action: Any) -> Step:
        self.t += 1
        self.sums = self.sums + action.sum(1)
        ended, nothing = np.array([self.t >= length for length in LENGTHS]), np.zeros(self.batch, np.int64)
        return Step(Observation(None, None, None), self.sums, nothing > 0, nothing, {}, nothing, nothing, ended, ended)


@pytest.fixture
def recorded() -> tuple[list[Any], list[Any]]:
    random = np.random.default_rng(0)
    actions = [random.uniform(-1, 1, (length, 2)).astype(np.float32) for length in LENGTHS]
    return actions, [np.cumsum(episode.sum(1).astype(np.float64)).astype(np.float32) for episode in actions]


def played(actions: list[Any], rewards: list[Any], tolerance: float = 0.0) -> list[Any]:
    task: Any = Counting()
    return list(play(task, range(5, 5 + task.batch), actions, rewards, tolerance))


def test_there_is_a_moment_before_every_decision_and_one_after_the_last(recorded):
    moments = played(*recorded)
    assert [moment.t for moment in moments] == [0, 1, 2, 3, 4]
    assert [moment.alive.tolist() for moment in moments] == [[t < length for length in LENGTHS] for t in range(5)]
    np.testing.assert_array_equal([moment.action for moment in moments[:-1]], side_by_side(recorded[0]))
    assert not moments[-1].action.any()
    assert moments[0].last is None
    assert [moment.last.ended.sum() for moment in moments[1:]] == [0, 1, 2, 3]


def test_a_reward_may_differ_by_the_tolerance_and_no_more(recorded):
    actions, rewards = recorded
    rewards[2][1] += 3e-5
    assert len(played(actions, rewards, 1e-4)) == 5
    with pytest.raises(ArtifactError, match="episode 2 is not the recorded one from decision 1 on: the reward is") as caught:
        played(actions, rewards)
    assert "other libraries" in str(caught.value.hint)


@pytest.mark.parametrize(("by", "what", "at"), [(-1, "goes on", 0), (1, "ends", 1)])
def test_an_episode_of_another_length_is_refused(by, what, at, recorded):
    actions, rewards = recorded
    actions[1], rewards[1] = np.resize(actions[1], (2 + by, 2)), np.resize(rewards[1], 2 + by)
    with pytest.raises(ArtifactError, match=f"episode 1 is not the recorded one from decision {at} on: the episode {what} here"):
        played(actions, rewards)
