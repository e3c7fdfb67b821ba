"""Lidars by hand, and rays against brute force."""

import numpy as np
import pytest

from wasp_cli.tasks.features import RAYS, lidars, ray_distances
from wasp_cli.tasks.outline import distance_to_segments, segments


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
