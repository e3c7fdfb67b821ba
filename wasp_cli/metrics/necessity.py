"""Was an intervention necessary? The counterfactual measures of the paper's section 5.3.

At an intervened step two branches run for W decision steps from the same state with common random
numbers: the assisted one executes the method's action first, the counterfactual one the operator's
command; then both follow the operator. With swapped roles the same branches tell whether the
command was necessary instead of the intervention, which is the floor of the measure.

Dimension letters: N intervened steps, W steps of a branch (terms after the end of an episode are
0).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# names of the two branches
ASSISTED = "asst"  # the method's action first
ALONE = "cf"  # the operator's command from the first step on


class Necessity(NamedTuple):
    """The effects of N interventions."""

    rho: Floats  # [N] risk: mean cost of the counterfactual branch (Eq. 19)
    delta_c: Floats  # [N] cost avoided (Eq. 20)
    delta_r: Floats  # [N] reward gained (Eq. 20)
    unnecessary: Bools  # [N] neither avoided cost nor gained more than tau_R (Eq. 21)
    swapped: Bools
    """[N] Eq. 21 with swapped roles: against the intervention, the command neither avoided cost nor
    gained more than tau_R.
    """
    effective: Bools
    """[N] whether the branches differ at any step, in cost or in reward; otherwise the intervention
    changed nothing.
    """

    @property
    def uir(self) -> float:
        """Unnecessary intervention rate (Eq. 21); NaN, not 0, without any intervention."""
        return _share(self.unnecessary)

    @property
    def uir_swapped(self) -> float:
        """UIR with swapped roles of the branches. It equals UIR for interventions that help as
        often as they harm.
        """
        return _share(self.swapped)

    @property
    def uir_eff(self) -> float:
        """UIR among the interventions that changed anything; NaN where none did."""
        return _share(self.unnecessary[self.effective])


def _share(mask: Bools) -> float:
    """Return the share of a mask [N] that is true; NaN where N is 0."""
    return float(mask.mean()) if len(mask) else float("nan")


def necessity(
    cost_cf: Floats, cost_asst: Floats, reward_cf: Floats, reward_asst: Floats, tau_R: float
) -> Necessity:
    """Judge N interventions by Eq. 19-21.

    Args:
        cost_cf: [N, W] cost of the counterfactual branch per step.
        cost_asst: [N, W] cost of the assisted branch.
        reward_cf: [N, W] reward of the counterfactual branch.
        reward_asst: [N, W] reward of the assisted branch.
        tau_R: return improvement below which an intervention that avoids no cost is unnecessary.

    Raises:
        ValueError: the branches have different shapes, or no step.
    """
    shape = np.shape(cost_cf)
    alike = all(np.shape(each) == shape for each in (cost_asst, reward_cf, reward_asst))
    if len(shape) != 2 or shape[1] == 0 or not alike:
        raise ValueError("the branches need the same shape [N, W] with W >= 1")
    delta_c = cost_cf.sum(1) - cost_asst.sum(1)
    delta_r = reward_asst.sum(1) - reward_cf.sum(1)
    return Necessity(
        rho=cost_cf.mean(1),
        delta_c=delta_c,
        delta_r=delta_r,
        unnecessary=(delta_c <= 0.0) & (delta_r <= tau_R),
        swapped=(delta_c >= 0.0) & (delta_r >= -tau_R),
        effective=((cost_cf != cost_asst) | (reward_cf != reward_asst)).any(1),
    )
