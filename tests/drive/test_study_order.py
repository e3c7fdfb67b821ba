from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest

from wasp_cli.spec.model import balanced_order


@pytest.mark.parametrize("conditions", range(1, 10))
def test_orders_are_balanced(conditions: int) -> None:
    """Every condition stands in every place, and follows every other one, equally often."""
    participants = conditions if conditions % 2 == 0 or conditions == 1 else 2 * conditions
    orders = [balanced_order(conditions, participant) for participant in range(participants)]
    assert all(sorted(order) == list(range(conditions)) for order in orders)
    places = Counter((place, condition) for order in orders for place, condition in enumerate(order))
    assert len(set(places.values())) == 1
    assert len(places) == conditions**2
    follows = Counter(pair for order in orders for pair in pairwise(order))
    assert len(follows) == conditions * (conditions - 1)
    assert len(set(follows.values())) <= 1


def test_numbers_beyond_the_square_begin_again() -> None:
    assert balanced_order(4, 9) == balanced_order(4, 1)
