"""The map from above: things are where they are, and the robot points where it drives."""

import numpy as np
import pytest

from tests.tasks.test_camera import turned
from wasp_cli.tasks.camera.appearance import Appearance, Scene, Things
from wasp_cli.tasks.camera.topdown import draw_map
from wasp_cli.tasks.formula.appearance import appearance as formula_appearance
from wasp_cli.tasks.goal.appearance import appearance as goal_appearance
from wasp_cli.tasks.race.appearance import appearance as race_appearance

SIZE = 256


def scene(appearance: Appearance, at=(0.0, 0.0), heading=0.0, **things) -> Scene:
    yaw = heading - np.arctan2(appearance.forward[1], appearance.forward[0])
    placed = {}
    for kind in appearance.kinds:
        where = np.array(things.get(kind.name, np.zeros((0, 2))), float).reshape(1, -1, 2)
        position = np.concatenate([where, np.zeros((*where.shape[:2], 1))], axis=-1)
        placed[kind.name] = Things(position, np.broadcast_to(np.eye(3), (*where.shape[:2], 3, 3)), np.ones(where.shape[:2], np.bool_))
    return Scene(np.array([[*at, 0.1]]), turned(yaw)[None], placed)


def at(image: np.ndarray, place, centre, half_side) -> np.ndarray:
    column = int((place[0] - centre[0] + half_side) / (2 * half_side) * len(image))
    row = int((centre[1] + half_side - place[1]) / (2 * half_side) * len(image))
    return image[row, column].astype(int)


def test_things_of_goal_are_where_they_are():
    image = draw_map(goal_appearance(1), scene(goal_appearance(1), goal=[(1.0, 0.5)], hazard=[(-1.0, 0.5)], vase=[(-0.5, -1.2)]), 0, SIZE)
    assert image.shape == (SIZE, SIZE, 3)
    assert image.dtype == np.uint8
    red, green, blue = at(image, (1.0, 0.5), (0, 0), 2.0)
    assert green > red + 20
    assert green > blue + 20
    red, green, blue = at(image, (-1.0, 0.5), (0, 0), 2.0)
    assert blue > red + 20
    assert blue > green + 20
    assert at(image, (-0.5, -1.2), (0, 0), 2.0).tolist() == [0, 255, 255]
    # Nothing where nothing is.
    assert np.ptp(at(image, (-1.0, -0.5), (0, 0), 2.0)) < 35


@pytest.mark.parametrize("appearance", [goal_appearance(1), race_appearance(1), formula_appearance(1)])
@pytest.mark.parametrize("heading", [0.0, 0.7, 2.5, -1.5])
def test_the_heading_is_seen(appearance, heading):
    """The white tip lies ahead of the middle of everything that the robot changed."""
    around = ((0.5, 1.0), 0.5)
    gone = scene(appearance, (80.0, 80.0), heading)
    there = scene(appearance, (0.5, 1.0), heading)
    image = draw_map(appearance, there, 0, SIZE, around)
    white = (image == 255).all(axis=-1) & (draw_map(appearance, gone, 0, SIZE, around) != image).any(axis=-1)
    rows, columns = np.nonzero(white)
    assert len(rows) > 50
    ahead = np.array([columns.mean() - SIZE / 2, SIZE / 2 - rows.mean()])
    ahead /= np.hypot(*ahead)
    assert ahead @ [np.cos(heading), np.sin(heading)] > 0.97
