"""The rule by which a severity is chosen, beside a search of every severity."""

import math

import numpy as np
import pytest

from wasp_cli.metrics.severity import choose, nearest, share_kept


def first_at_most(severities, shares, kept, points: int = 200_001) -> float | None:
    """The mildest severity at which the straight lines between known shares are at most `kept`."""
    fine = np.linspace(severities[0], severities[-1], points)
    below = np.interp(fine, severities, shares) <= kept
    return float(fine[below.argmax()]) if below.any() else None


@pytest.mark.parametrize("seed", range(30))
def test_the_choice_is_the_first_severity_of_the_curve_that_keeps_no_more(seed):
    random = np.random.default_rng(seed)
    severities = np.sort(random.uniform(0.0, 2.0, random.integers(2, 7)))
    shares = random.uniform(-0.2, 1.2, len(severities))  # noise may let it rise again
    kept = float(random.uniform(0.2, 0.8))
    found = choose(severities.tolist(), shares.tolist(), kept)
    expected = first_at_most(severities, shares, kept)
    assert found.within == (shares[0] >= kept and expected is not None)
    end = severities[0] if shares[0] < kept else severities[-1]
    wanted = expected if found.within else end
    assert found.severity == pytest.approx(wanted, abs=2e-5)


def test_a_share_that_is_known_exactly_is_taken_as_it_is():
    assert choose([0.1, 0.2, 0.3], [0.9, 0.6, 0.1], 0.6).severity == 0.2
    assert choose([0.1, 0.2], [0.6, 0.6], 0.6) == choose([0.1], [0.6], 0.6)
    assert choose([0.1], [0.6], 0.6).within


@pytest.mark.parametrize("seed", range(30))
def test_where_nothing_lies_between_the_neighbour_with_the_nearer_share_is_taken(seed):
    random = np.random.default_rng(seed)
    severities = [1.0, 0.5, 0.25, 0.1]  # a skill: the worst is the least
    shares = np.sort(random.uniform(0.0, 1.0, 4))[::-1].tolist()
    found = nearest(severities, shares, 0.5)
    distances = [abs(share - 0.5) for share in shares]
    assert found.severity == severities[int(np.argmin(distances))]
    assert found.within == (shares[0] >= 0.5 >= shares[-1])


def test_a_share_is_of_the_way_also_below_zero():
    assert share_kept(-120.0, random=-180.0, expert=-80.0) == pytest.approx(0.6)
    assert share_kept(-200.0, random=-180.0, expert=-80.0) == pytest.approx(-0.2)
    assert math.isnan(share_kept(1.0, random=2.0, expert=2.0))
    assert math.isnan(share_kept(1.0, random=2.0, expert=1.0))
