"""Two evaluations of one cell: the test against every flip written out, and the corrections
against their definitions.
"""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.report.made import one_cell
from wasp_cli.cells.table import CellTable, Floats
from wasp_cli.compare.paired import EXACT, MEASURES, corrected, paired_episodes
from wasp_cli.report.bootstrap import difference_of
from wasp_cli.store.tables import CellIdentity

IDENTITY = CellIdentity("goal1", "wasp", "full", "laggy", 0.5, 0)


def cell(rows: Floats, worlds: Floats | None = None) -> CellTable:
    """From rows [n, M] of the measures."""
    episodes = {name: rows[:, i].astype(np.float64) for i, name in enumerate(MEASURES)}
    place = np.arange(len(rows)) + 100.0 if worlds is None else worlds
    return one_cell(IDENTITY, place, None, **episodes)


def rows(seed: int, n: int, shift: float = 0.0) -> Floats:
    draws = np.random.default_rng(seed)
    found: Floats = np.round(
        draws.normal(0, 1, (n, len(MEASURES))) * [5, 20, 0.1, 0.2, 1]
        + shift * np.array([1, 4, 0, 0, 0]),
        3,
    )
    return found


def by_every_flip(before: Floats, after: Floats) -> list[float]:
    """The definition, in loops."""
    change = after - before
    size = [sum(value**2 for value in column) ** 0.5 for column in change.T]

    def standardised(signs: tuple[int, ...]) -> list[float]:
        sums = [
            abs(sum(sign * value for sign, value in zip(signs, column, strict=True)))
            for column in change.T
        ]
        return [total / scale if scale else 0.0 for total, scale in zip(sums, size, strict=True)]

    own = standardised((1,) * len(change))
    flips = [max(standardised(signs)) for signs in product((1, -1), repeat=len(change))]
    return [sum(largest >= value * (1 - 1e-9) for largest in flips) / len(flips) for value in own]


@pytest.mark.parametrize(("n", "shift"), [(1, 0.0), (2, 3.0), (5, 0.0), (7, 4.0), (8, 30.0)])
def test_p_values_against_every_flip_in_loops(n: int, shift: float) -> None:
    before, after = rows(1, n), rows(2, n, shift)
    found = paired_episodes(cell(before), cell(after))
    assert [found.differences[name].p for name in MEASURES] == pytest.approx(
        by_every_flip(before, after)
    )
    assert (found.worlds, found.episodes, found.least) == (n, (n, n), 2.0 ** (1 - n))
    assert all(each.p >= found.least for each in found.differences.values())


def test_many_worlds_are_flipped_by_chance_and_agree_with_all_flips() -> None:
    n = EXACT + 1
    before, after = rows(5, n), rows(6, n, 4.0)
    change = after - before
    signs = np.array(list(product((1.0, -1.0), repeat=n)))
    size = np.sqrt((change**2).sum(0))
    largest, own = (np.abs(signs @ change) / size).max(1), np.abs(change.sum(0)) / size
    found = paired_episodes(cell(before), cell(after))
    exact = [(largest >= value).mean() for value in own]
    assert [found.differences[name].p for name in MEASURES] == pytest.approx(exact, abs=0.02)
    assert found == paired_episodes(cell(before), cell(after))


def test_differences_and_intervals_are_those_of_the_bootstrap() -> None:
    before, after = cell(rows(1, 9)), cell(rows(2, 9, 2.0))
    found = paired_episodes(before, after)
    for name in MEASURES:
        estimate = difference_of(after, before, name)
        each = found.differences[name]
        assert each.value == pytest.approx(estimate.value)
        assert (each.interval.low, each.interval.high) == pytest.approx(
            (estimate.interval.low, estimate.interval.high)
        )
        assert (each.interval.unit, each.interval.clusters) == ("world", 9)


def test_only_worlds_in_common_are_paired_in_any_order() -> None:
    before, after = rows(1, 6), rows(2, 6, 2.0)
    places = np.array([5.0, 3.0, 1.0, 4.0, 2.0, 9.0])
    order = np.array([2, 4, 1, 3, 0, 5])
    shuffled = cell(after[order], np.where(places[order] == 9, 77.0, places[order]))
    found, plain = (
        paired_episodes(cell(before, places), shuffled),
        paired_episodes(cell(before[:5]), cell(after[:5])),
    )
    assert (found.worlds, found.episodes) == (5, (6, 6))
    for name in MEASURES:
        assert found.differences[name].value == pytest.approx(plain.differences[name].value)
        assert found.differences[name].p == pytest.approx(plain.differences[name].p)


def test_no_difference_has_p_1_and_one_world_no_interval() -> None:
    same = paired_episodes(cell(rows(1, 4)), cell(rows(1, 4)))
    assert {each.p for each in same.differences.values()} == {1.0}
    one = paired_episodes(cell(rows(1, 1)), cell(rows(2, 1)))
    assert {each.interval for each in one.differences.values()} == {None}
    assert {each.p for each in one.differences.values()} == {1.0}


def holm(p: list[float]) -> list[float]:
    """Holm's adjusted p-values by their definition: the running maximum of (m - k) p_(k)."""
    order = sorted(range(len(p)), key=lambda i: p[i])
    found = [0.0] * len(p)
    for step, i in enumerate(order):
        found[i] = min(
            1.0, max((len(p) - earlier) * p[order[earlier]] for earlier in range(step + 1))
        )
    return found


@settings(deadline=None, max_examples=60)
@given(p=st.lists(st.lists(st.floats(1e-4, 1.0), min_size=2, max_size=3), min_size=1, max_size=8))
def test_the_smallest_of_each_cell_is_corrected_by_holm(p: list[list[float]]) -> None:
    found = corrected([{str(i): value for i, value in enumerate(each)} for each in p])
    assert [min(each.values()) for each in found] == pytest.approx(holm([min(each) for each in p]))
    for before, after in zip(p, found, strict=True):
        assert all(value <= after[str(i)] <= 1.0 for i, value in enumerate(before))
    assert corrected([]) == []
