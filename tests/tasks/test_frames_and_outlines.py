"""Changes of frame, and outlines against brute force."""

import numpy as np

from wasp_cli.tasks.frames import ground_to_body, quaternion_rotation, to_body, yaw_quaternion, yaw_rotation
from wasp_cli.tasks.outline import distance_to_segments, inside, parse_outline, segments

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
