"""What a person who drives a world of vectors is shown of it."""

import gymnasium
import numpy as np

from tests.tasks.lights import Lights, registered
from wasp_cli.drive.view import PLOT, Eyes
from wasp_cli.tasks.declared import Declaration, declare
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.pictures import PICTURE


class Numbers(Lights):
    """Says what time it is, and may draw it."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, draws=False, render_mode=None):
        self.draws, self.render_mode = draws, render_mode

    def seen(self):
        return np.array([self.clock, -self.clock], np.float64)

    def render(self):
        return np.full((10, 10, 3), 100 + self.clock, np.uint8) if self.draws else None


def looked_at(draws):
    """Return what the page is told, and the pictures of three decisions."""
    name = f"numbers-{draws}"
    declare(name, Declaration(id=registered(Numbers), name=name, make={"draws": draws}))
    task = make_task(name, 1, action_repeat=1, observe=("state", PICTURE))
    eyes = Eyes(task)
    eyes.begin()
    seen = [eyes.look(task.reset([4]))]
    for _ in range(2):
        seen.append(eyes.look(task.step(np.zeros((1, 2))).observation))
    return eyes.said, [np.frombuffer(each, np.uint8).reshape(PLOT, PLOT, 3) for each in seen]


def test_a_world_that_draws_itself_is_shown_so():
    said, pictures = looked_at(draws=True)
    assert (said["plot"], said["drawn"]) == (True, True)
    assert [np.unique(picture).tolist() for picture in pictures] == [[100], [101], [102]]


def test_of_any_other_its_components_are():
    said, pictures = looked_at(draws=False)
    assert (said["plot"], said["drawn"]) == (True, False)
    assert all(len(np.unique(picture)) > 10 for picture in pictures)
