"""What assistants see of a task: images, or a vector where it shows no image."""

import gymnasium
import numpy as np
import pytest

from wasp_cli.learning.dataset import record
from wasp_cli.learning.informed import observed
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS
from wasp_cli.tasks.sight import seen_of


class Walk(gymnasium.Env):
    """A random walk that is pushed, and costs on one side."""

    metadata = {"render_modes": [], "render_fps": 10}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gymnasium.spaces.Dict(
        {"state": gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)}
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.normal(size=3)
        return {"state": self.place.copy()}, {}

    def step(self, action):
        self.place[:2] += action
        self.place[2] += self.np_random.normal()
        cost = {"cost": float(self.place[0] > 0)}
        return {"state": self.place.copy()}, float(action[0]), False, False, cost


gymnasium.register("Walk-v0", entry_point=Walk, max_episode_steps=12)


@pytest.mark.parametrize(
    ("task", "sight"), [("Walk-v0", "state"), ("puddle:Puddle-v0", "pixels"), ("goal1", "pixels")]
)
def test_assistants_see_images_or_where_there_are_none_the_vector(task, sight):
    assert seen_of(task) == sight
    assert observed(task) == (sight,)
    assert TASKS[task].cameras == {"Walk-v0": 0, "puddle:Puddle-v0": 1, "goal1": 2}[task]


def test_operators_who_know_more_are_told_more():
    assert observed("goal1-two") == ("pixels", "privileged")


def test_a_task_without_images_shows_none_whatever_is_asked_for():
    task = make_task("Walk-v0", 2, observe=("pixels", "state", "privileged"))
    seen = task.reset([0, 1])
    assert seen.pixels is None
    assert (seen.state.shape, seen.state.dtype) == ((2, 3), np.float64)
    assert task.step(np.zeros((2, 2))).observation.pixels is None


def test_its_episodes_are_recorded_with_their_vectors():
    task = make_task("Walk-v0", 2, observe=("state", "privileged"))
    data = record(task, [0, 1], lambda seen: np.ones((2, 2), np.float32), ["a", "b"], 0)
    assert data.reads == "state"
    assert data.pixels.size == 0
    assert data.state.shape == (len(data.first), 3)
    np.testing.assert_array_equal(data.state, data.privileged)
    pushed = np.flatnonzero(data.first == 0)
    moved = data.state[pushed, 0] - data.state[pushed - 1, 0]
    np.testing.assert_allclose(moved, task.action_repeat, atol=1e-5)
