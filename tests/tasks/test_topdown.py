"""The map from above: things are where they are, and the robot points where it drives."""

import numpy as np
import pytest

from tests.tasks.test_camera import APPEARANCES, scene
from wasp_cli.tasks.camera.topdown import draw_map

SIZE = 256


def at(image: np.ndarray, place, centre, half_side) -> np.ndarray:
    column = int((place[0] - centre[0] + half_side) / (2 * half_side) * len(image))
    row = int((centre[1] + half_side - place[1]) / (2 * half_side) * len(image))
    return image[row, column].astype(int)


def test_things_of_goal_are_where_they_are():
    there = scene("goal", goal=[(1.0, 0.5)], hazard=[(-1.0, 0.5)], vase=[(-0.5, -1.2)])
    image = draw_map(APPEARANCES["goal"](1), there, 0, SIZE)
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


@pytest.mark.parametrize("task", APPEARANCES)
@pytest.mark.parametrize("heading", [0.0, 0.7, 2.5, -1.5])
def test_the_heading_is_seen(task, heading):
    """The white tip lies ahead of the middle of everything that the robot changed."""
    appearance, around = APPEARANCES[task](1), ((0.5, 1.0), 0.5)
    gone, there = (scene(task, place, heading) for place in ((80.0, 80.0), (0.5, 1.0)))
    image = draw_map(appearance, there, 0, SIZE, around)
    white = (image == 255).all(axis=-1) & (
        draw_map(appearance, gone, 0, SIZE, around) != image
    ).any(axis=-1)
    rows, columns = np.nonzero(white)
    assert len(rows) > 50
    ahead = np.array([columns.mean() - SIZE / 2, SIZE / 2 - rows.mean()])
    ahead /= np.hypot(*ahead)
    assert ahead @ [np.cos(heading), np.sin(heading)] > 0.97
