"""How long an expert may train in an environment whose steps are slow."""

import pytest

from wasp_cli.plan.affordable import EXPERT_SECONDS, LEAST, affordable_interactions
from wasp_cli.plan.tried import Tried


def interactions(bare_seconds: float, cores: int = 2, action_repeat: int = 4) -> int | None:
    found = Tried(step_seconds=2 * bare_seconds, bare_seconds=bare_seconds, length=200.0)
    return affordable_interactions("quick", found, {"action_repeat": action_repeat}, cores)


def test_a_quick_environment_leaves_the_decisions_of_the_preset():
    assert interactions(0.0001) is None


def test_a_slow_one_trains_its_expert_in_the_time_that_is_given():
    decisions = interactions(0.005)
    assert decisions is not None
    assert decisions * 4 * 0.005 / 2 == pytest.approx(EXPERT_SECONDS, rel=0.06)


def test_more_cores_train_it_longer_until_the_preset_is_reached():
    assert interactions(0.01, cores=2) < interactions(0.01, cores=4)
    assert interactions(0.01, cores=64) is None


def test_the_slowest_one_trains_its_expert_for_a_few_decisions_still():
    assert interactions(1.0) == LEAST
