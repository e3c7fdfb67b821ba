from __future__ import annotations

import math

import numpy as np
import pytest

from wasp_cli.metrics.necessity import necessity


def test_by_hand() -> None:
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


def test_rate_of_no_intervention_is_undefined() -> None:
    nothing = np.zeros((0, 15))
    assert math.isnan(necessity(nothing, nothing, nothing, nothing, 0.1).uir)


def test_refuses_branches_of_different_length() -> None:
    with pytest.raises(ValueError, match="same shape"):
        necessity(np.zeros((2, 15)), np.zeros((2, 14)), np.zeros((2, 15)), np.zeros((2, 15)), 0.1)
