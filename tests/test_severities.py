"""docs/examples/severities.py judges the published operators without assistance."""

import shutil
from pathlib import Path

import severities
import yaml

from tests.compare.two_runs import SPEC, write_results
from tests.test_docs import ROOT


def test_severer_operators_do_worse_but_for_limited_skill_on_race1() -> None:
    checked = list(severities.check(ROOT / "specs" / "severity.yaml", ROOT / "results" / "published"))
    missed = [(task, operator) for task, operator, verdict, _ in checked if verdict != "accepted"]
    assert (len(checked), missed) == (8, [("race1", "limited-skill")])
    assert [severities.against(*numbers) for numbers in ((-1.0, 9.0), (1.0, 0.9), (1.0, 0.5))] == ["accepted", "undecided", "not accepted"]


def test_the_spec_need_not_be_the_one_that_ran_last(tmp_path: Path) -> None:
    who = {"methods": ["human", "expert"]}
    side = write_results(tmp_path / "results", **who)
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump({**SPEC, **who}))
    later = shutil.copytree(side.layout.run(side.run_id), side.layout.run("20270101-000000-later-0000"))
    (later / "plan.json").write_text('{"spec": "later", "cells": []}')
    assert len(list(severities.check(tmp_path / "tiny.yaml", side.layout.root))) == 2
