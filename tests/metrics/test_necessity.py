import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from wasp_cli.metrics.necessity import necessity


def test_by_hand():
    cost_cf = np.array([[0.0, 1, 1], [0, 0, 0], [1, 0, 0], [0, 0, 0]])
    cost_asst = np.array([[0.0, 0, 1], [0, 0, 0], [1, 1, 0], [0, 0, 0]])
    reward_cf = np.array([[1.0, 1, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    reward_asst = np.array([[1.0, 0, 0], [0.25, 0.25, 0], [0, 0, 0], [1, 0, 0]])
    found = necessity(cost_cf, cost_asst, reward_cf, reward_asst, tau_R=0.5)
    assert found.rho.tolist() == pytest.approx([2 / 3, 0, 1 / 3, 0])
    assert found.delta_c.tolist() == [1, 0, -1, 0]
    assert found.delta_r.tolist() == [-2, 0.5, 0, 1]
    # Cost avoided; gain equal to the threshold; cost added without gain; gain above the threshold.
    assert found.unnecessary.tolist() == [False, True, True, False]
    assert found.uir == 0.5
    # The command gained more than the threshold; loses as much; avoided a cost; loses more.
    assert found.swapped.tolist() == [False, True, False, True]
    assert found.uir_swapped == 0.5


def test_rate_of_no_intervention_is_undefined():
    nothing = np.zeros((0, 15))
    found = necessity(nothing, nothing, nothing, nothing, 0.1)
    assert all(math.isnan(rate) for rate in (found.uir, found.uir_swapped, found.uir_eff))


BRANCHES = hnp.arrays(np.float64, (4, 9, 3), elements=st.sampled_from([0.0, 0.25, 1.0]))


@given(BRANCHES, st.sampled_from([0.0, 0.25, 0.6]))
def test_swapped_judges_the_branches_in_each_others_place_and_effective_leaves_out_twins(branches, tau_R):
    cost_cf, cost_asst, reward_cf, reward_asst = branches
    cost_cf, cost_asst = cost_cf.round(), cost_asst.round()
    found = necessity(cost_cf, cost_asst, reward_cf, reward_asst, tau_R)
    assert found.uir_swapped == necessity(cost_asst, cost_cf, reward_asst, reward_cf, tau_R).uir
    unnecessary = []
    for i in range(9):
        differs = any(cost_cf[i, w] != cost_asst[i, w] or reward_cf[i, w] != reward_asst[i, w] for w in range(3))
        assert found.effective[i] == differs
        assert differs or found.unnecessary[i]
        unnecessary += [found.unnecessary[i]] * differs
    assert found.uir_eff == pytest.approx(np.mean(unnecessary) if unnecessary else math.nan, nan_ok=True)


def test_refuses_branches_of_different_length():
    with pytest.raises(ValueError, match="same shape"):
        necessity(np.zeros((2, 15)), np.zeros((2, 14)), np.zeros((2, 15)), np.zeros((2, 15)), 0.1)
