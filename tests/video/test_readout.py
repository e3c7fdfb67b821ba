"""Paths that are read out of latents: the geometry, and that the fit finds what is linear and nothing else."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.video.trace import PARTS, displacements, fit, fit_within, integrated

FEATURES = 12


def world(seed: int, noise: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Six episodes whose displacements are linear in the features, but for noise."""
    random = np.random.default_rng(seed)
    weights = random.normal(size=(FEATURES, 3)) * [0.02, 0.01, 0.1]
    features = [random.normal(size=(80, FEATURES)).astype(np.float32) for _ in range(6)]
    moves = [x @ weights + [0.05, 0.0, 0.01] + noise * random.normal(size=(80, 3)) * weights.std(0) for x in features]
    return features, moves


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_displacements_put_together_are_the_way(seed: int, length: int) -> None:
    random = np.random.default_rng(seed)
    poses = np.concatenate([random.normal(size=(length + 1, 2)), random.uniform(-3.1, 3.1, (length + 1, 1))], 1)
    found = integrated(poses[0], displacements(poses))
    np.testing.assert_allclose(found, poses[:, :2], atol=1e-9)


def test_displacements_are_seen_from_the_robot() -> None:
    # It looks along +y and goes to the left of where it looks, which is -x, while it turns by a quarter to the left.
    poses = np.array([[1.0, 2.0, np.pi / 2], [0.5, 2.0, np.pi]])
    np.testing.assert_allclose(displacements(poses), [[0.0, 0.5, np.pi / 2]], atol=1e-12)


def test_what_is_linear_is_found() -> None:
    features, moves = world(0, noise=0.0)
    readout = fit(features[1:], moves[1:])
    assert (readout.explained(features[0], moves[0]) > 0.999).all()
    np.testing.assert_allclose(readout(features[0][3]), moves[0][3], atol=2e-3)


def test_of_one_episode_alone_each_part_is_predicted_from_the_others() -> None:
    features, moves = world(3, noise=0.0)
    readout, explained = fit_within(features[0], moves[0])
    assert (explained > 0.99).all()
    assert (readout.explained(features[1], moves[1]) > 0.99).all()
    shuffled = np.random.default_rng(4).permutation(moves[0])
    assert (fit_within(features[0], shuffled)[1] < 0.2).all()  # in its own fit, it would look explained
    readout, explained = fit_within(features[0][: 2 * PARTS - 1], moves[0][: 2 * PARTS - 1])
    assert readout is None
    assert np.isnan(explained).all()


def test_what_never_moves_has_no_share_and_nothing_cannot_be_fitted() -> None:
    features, moves = world(4, noise=0.0)
    still = [move * [1.0, 0.0, 1.0] for move in moves]
    shares = fit(features[1:], still[1:]).explained(features[0], still[0])
    assert np.isnan(shares).tolist() == [False, True, False]
    with pytest.raises(ValueError, match="no decision"):
        fit([features[0][:0]], [moves[0][:0]])
