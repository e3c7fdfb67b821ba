"""Lidars by hand, rays and outlines against brute force, changes of frame."""

import numpy as np
import pytest

from wasp_cli.tasks.features import RAYS, lidars, ray_distances
from wasp_cli.tasks.frames import ground_to_body, quaternion_rotation, to_body, yaw_quaternion, yaw_rotation
from wasp_cli.tasks.outline import distance_to_segments, inside, parse_outline, segments


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
    dense = np.stack([np.linalg.norm((1 - share) * a + share * b - places[:, None], axis=2).min(axis=1) for a, b in sides], axis=1)
    np.testing.assert_allclose(distance_to_segments(places, sides), dense, atol=2e-3)


def test_inside():
    places = np.array([(1.0, 1.0), (3.0, 1.0), (-0.1, 0.5), (1.999, 0.001)])
    assert inside(places, SQUARE).tolist() == [True, False, False, True]
    assert inside(places, SQUARE[::-1]).tolist() == [True, False, False, True]


def test_frames_agree():
    rng = np.random.default_rng(2)
    yaw = rng.uniform(-3.0, 3.0, 5)
    np.testing.assert_allclose(quaternion_rotation(yaw_quaternion(yaw)), yaw_rotation(yaw), atol=1e-15)
    points, xy = rng.normal(size=(5, 3, 2)), rng.normal(size=(5, 2))
    upright = np.concatenate([xy, np.full((5, 1), 0.1)], axis=1)
    np.testing.assert_allclose(ground_to_body(points, upright, yaw_rotation(yaw)), to_body(points, xy, yaw), atol=1e-15)


def test_tilted_bodies_see_the_ground_below():
    # A body that looks straight down along its x axis sees what is 1 m below it 1 m ahead.
    down = np.array([[[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]])
    np.testing.assert_allclose(ground_to_body(np.zeros((1, 1, 2)), np.array([[0.0, 0.0, 1.0]]), down), [[[1.0, 0.0]]], atol=1e-15)
