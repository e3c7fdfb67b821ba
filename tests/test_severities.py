"""docs/examples/severities.py judges the published operators without assistance."""

import severities

from tests.test_docs import ROOT


def test_severer_operators_do_worse_but_for_limited_skill_on_race1() -> None:
    checked = list(severities.check(ROOT / "specs" / "severity.yaml", ROOT / "results" / "published"))
    missed = [(task, operator) for task, operator, verdict, _ in checked if verdict != "accepted"]
    assert (len(checked), missed) == (8, [("race1", "limited-skill")])
    assert [severities.against(*numbers) for numbers in ((-1.0, 9.0), (1.0, 0.9), (1.0, 0.5))] == ["accepted", "undecided", "not accepted"]
