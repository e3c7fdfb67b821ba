"""For how long WASP waits where no plan is safe."""

import pytest
import torch

from tests.methods.wasp.test_decision import decided, expert, ready, unimpaired
from wasp_cli.methods.wasp.patience import Patience
from wasp_cli.metrics.episode import GATE_SAFETY
from wasp_cli.models.base import Latent

INSIDE = 0.35  # of the hazard: whatever is done, the next steps cost
BEFORE = -2.0  # where nothing costs
COMMAND = -0.5
UNSAFE = {"tau_c": 0.05, "tau_r": -9.0, "variant": "safety-only"}


def goes_on(assistant, x: float) -> bool:
    """Decide once, and return whether the expert's action was executed without a search."""
    decision = decided(assistant, x, COMMAND)
    searched = bool((decision.planned.safe >= 0).any())
    assert int(decision.record.gate) == GATE_SAFETY
    if not searched:
        assert float(decision.action) == pytest.approx(expert(x))
    return not searched


@pytest.mark.parametrize("limit", [1, 2, 5])
def test_the_expert_goes_on_for_as_many_decisions_as_were_waited(limit):
    assistant = ready(patience=limit, **UNSAFE)
    seen = [goes_on(assistant, INSIDE) for _ in range(4 * limit)]
    assert seen == ([False] * limit + [True] * limit) * 2


def test_a_horizon_of_patience_is_as_many_decisions_as_are_imagined():
    assistant = ready(patience="horizon", **UNSAFE)
    seen = [goes_on(assistant, INSIDE) for _ in range(2 * assistant.horizon)]
    assert seen == [False] * assistant.horizon + [True] * assistant.horizon


def test_it_goes_on_waiting_where_the_expert_would_gain_nothing():
    assistant = ready(**{**UNSAFE, "patience": 2, "tau_r": 9.0})
    assert not any(goes_on(assistant, INSIDE) for _ in range(10))


def test_without_patience_set_it_waits_for_as_long_as_no_plan_is_safe():
    assistant = ready(**UNSAFE)
    assert not any(goes_on(assistant, INSIDE) for _ in range(40))


def test_a_safe_future_ends_the_wait_and_that_the_expert_goes_on():
    assistant = ready(patience=3, **UNSAFE)
    before = [goes_on(assistant, INSIDE) for _ in range(2)]
    decided(assistant, BEFORE, COMMAND)
    again = [goes_on(assistant, INSIDE) for _ in range(4)]
    assert before + again == [False] * 5 + [True]
    decided(assistant, BEFORE, COMMAND)
    assert not goes_on(assistant, INSIDE)


def test_a_new_episode_begins_without_the_wait_of_the_last_one():
    assistant = ready(patience=2, **UNSAFE)
    assert [goes_on(assistant, INSIDE) for _ in range(2)] == [False, False]
    assistant.reset(torch.ones(1, dtype=torch.bool), [3])
    assert [goes_on(assistant, INSIDE) for _ in range(3)] == [False, False, True]


def test_episodes_side_by_side_wait_each_for_itself():
    assistant = ready(rows=2, patience=2, **UNSAFE)
    one = assistant.imagination.model.at(INSIDE)
    both = Latent(one.h.repeat(2, 1), one.z.repeat(2, 1))
    commands = torch.full((2, 1), COMMAND)
    seen = []
    for t in range(4):
        if t == 1:  # the second one begins anew, one decision later
            assistant.reset(torch.tensor([False, True]), [3, 4])
        decision = assistant.decide(both, commands, unimpaired(2))
        seen.append((decision.planned.safe < 0).all(-1).tolist())
    assert seen == [[False, False], [False, False], [True, False], [True, True]]


def test_decisions_that_are_not_made_are_not_counted():
    patience = Patience(2)
    patience.reset(torch.ones(3, dtype=torch.bool))
    here, true = torch.tensor([0, 2]), torch.ones(2, dtype=torch.bool)
    for _ in range(2):
        patience.count(here, true, true)
    assert patience.is_over(torch.arange(3)).tolist() == [True, False, True]
