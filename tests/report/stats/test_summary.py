from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.report.stats.frame import CellNumbers, Wanted, read_frame
from wasp_cli.report.stats.summary import distinct_resamples, over_episodes, over_seeds, paired_difference, spread_note, summarise
from wasp_cli.store.tables import CellIdentity


def cell(seed: int, value: float, number: float, costs: Sequence[float] = (0.0,)) -> CellNumbers:
    identity = CellIdentity("goal1", "ida", "full", "noisy", value, seed)
    return CellNumbers(identity, "mild", {"return": number}, {"cost": np.array(costs, np.float64)})


def test_mean_and_spread_by_hand() -> None:
    cells = [cell(0, 0.2, 1.0), cell(0, 0.4, 3.0), cell(1, 0.2, 5.0), cell(1, 0.4, 7.0)]
    value = summarise(cells, "return")
    assert (value.mean, value.n) == (4.0, 2)
    assert value.sd == pytest.approx(math.sqrt(8))  # of the seed means 2 and 6, not of the four cells


def test_one_seed_has_no_spread() -> None:
    value = summarise([cell(0, 0.2, 1.0), cell(0, 0.4, 3.0)], "return")
    assert (value.mean, value.sd, value.n) == (2.0, None, 1)


def test_undefined_cells_are_left_out() -> None:
    value = summarise([cell(0, 0.2, math.nan), cell(0, 0.4, 3.0), cell(1, 0.2, math.nan)], "return")
    assert (value.mean, value.n) == (3.0, 1)
    nothing = summarise([cell(0, 0.2, math.nan)], "return")
    assert (nothing.mean, nothing.ranked) == (None, False)


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=8))
def test_spread_is_that_of_numpy(means: list[float]) -> None:
    value = over_seeds(means)
    assert value.mean == pytest.approx(np.mean(means))
    assert value.sd == pytest.approx(np.std(means, ddof=1))


def test_paired_difference_uses_what_both_have() -> None:
    reference = [cell(0, 0.2, 1.0), cell(0, 0.4, 10.0), cell(1, 0.2, 2.0)]
    assert paired_difference([cell(0, 0.2, 4.0), cell(1, 0.2, 3.0), cell(2, 0.2, 99.0)], reference, "return") == 2.0
    assert paired_difference([cell(5, 0.2, 1.0)], reference, "return") is None
    assert paired_difference([cell(0, 0.2, math.nan)], reference, "return") is None


def test_episodes_are_pooled_over_cells() -> None:
    cells = [cell(0, 0.2, 0, [0, 1, 2]), cell(1, 0.2, 0, [100])]
    assert over_episodes(cells, "cost", np.median).mean == 1.5
    assert over_episodes(cells, "cost", np.max).mean == 100
    assert over_episodes([], "cost", np.max).mean is None


def test_how_coarse_three_seeds_are() -> None:
    assert [distinct_resamples(seeds) for seeds in (0, 1, 2, 3, 5, 10)] == [0, 1, 3, 10, 126, 92378]


def test_the_note_states_the_unit(grid: Callable[..., list[Wanted]]) -> None:
    three = spread_note(read_frame(grid()).cells)
    assert "means of 3 seeds, not over episodes" in three
    assert "10 distinct bootstrap resamples" in three
    assert "no ±" in spread_note([cell(4, 0.2, 1.0)])
    assert "No cell" in spread_note([])
