"""Which numbers follow from a task of one's own, and that those of this package keep theirs."""

import pytest

from wasp_cli.learning.configs.recorded import chosen_limit
from wasp_cli.spec.own_units import with_auto

OWN = "puddle:Puddle-v0"
AUTO = {"expert": {"cost_limit": "auto"}, "wasp": {"tau_c": "auto"}}


def test_a_task_of_ones_own_has_both_and_one_of_this_package_none():
    assert with_auto((OWN, "goal1"), ("human", "wasp"), {}, {}) == {OWN: AUTO}


def test_what_a_spec_writes_stays():
    everywhere = {"expert": {"cost_limit": 25.0}, "wasp": {"tau_c": 1.0}}
    assert with_auto((OWN,), ("wasp",), {}, everywhere) == {}
    here = {OWN: {"expert": {"cost_limit": 3.0}, "dataset": {"steps": 10}}}
    found = with_auto((OWN,), ("wasp",), here, {})
    assert found == {OWN: {**here[OWN], "wasp": {"tau_c": "auto"}}}
    assert here[OWN].keys() == {"expert", "dataset"}, "the document is left as it is"


@pytest.mark.parametrize(("rate", "limit"), [(0.0, 1.0), (8.0, 1.0), (60.0, 6.0), (900.0, 25.0)])
def test_a_limit_is_a_tenth_of_what_random_commands_cost_within_bounds(rate, limit):
    assert chosen_limit(rate) == pytest.approx(limit)
