"""Which numbers follow from a task of one's own, and that those of this package keep theirs."""

import pytest

from wasp_cli.errors import ArtifactError
from wasp_cli.spec.own_units import with_auto
from wasp_cli.stages.expert_limit import chosen_allowance, chosen_limit, expert_limit

OWN = "puddle:Puddle-v0"
STAGES = {
    "expert": {"cost_limit": "auto"},
    "policies": {"cost_allowance": "auto"},
    "residual": {"cost_limit": "auto"},
}
AUTO = {**STAGES, "wasp": {"tau_c": "auto", "patience": "horizon"}}


def test_a_task_of_ones_own_has_all_of_them_and_one_of_this_package_none():
    assert with_auto((OWN, "goal1"), ("human", "wasp"), {}, {}) == {OWN: AUTO}


def test_what_a_spec_writes_stays():
    everywhere = {
        "expert": {"cost_limit": 25.0},
        "policies": {"cost_allowance": 2.5},
        "residual": {"cost_limit": 25.0},
        "wasp": {"tau_c": 1.0, "patience": 4},
    }
    assert with_auto((OWN,), ("wasp",), {}, everywhere) == {}
    here = {OWN: {"expert": {"cost_limit": 3.0}, "dataset": {"steps": 10}}}
    found = with_auto((OWN,), ("wasp",), here, {})
    assert found == {OWN: {**AUTO, **here[OWN]}}
    assert here[OWN].keys() == {"expert", "dataset"}, "the document is left as it is"


@pytest.mark.parametrize(("rate", "limit"), [(0.0, 1.0), (8.0, 1.0), (60.0, 6.0), (900.0, 25.0)])
def test_a_limit_is_a_tenth_of_what_random_commands_cost_within_bounds(rate, limit):
    assert chosen_limit(rate) == pytest.approx(limit)


def test_an_allowance_is_a_tenth_of_the_limit():
    """As 2.5 and 25 of this package's tasks are to each other."""
    assert chosen_allowance(25.0) == pytest.approx(2.5)
    assert chosen_allowance(1.0) == pytest.approx(0.1)


def test_an_expert_that_does_not_say_its_limit_is_an_error_with_a_remedy(tmp_path):
    with pytest.raises(ArtifactError) as caught:
        expert_limit(tmp_path)
    assert "cost_allowance" in caught.value.hint
