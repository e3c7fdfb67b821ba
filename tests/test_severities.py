"""docs/examples/severities.py judges the published operators without assistance."""

import json
from pathlib import Path

import severities

from tests.compare.two_runs import SPEC, write_results
from tests.test_docs import ROOT
from wasp_cli.store.records import write_record


def test_severer_operators_do_worse_but_for_limited_skill() -> None:
    checked = list(
        severities.check(ROOT / "specs" / "severity.yaml", ROOT / "results" / "published")
    )
    missed = {
        task: (operator, verdict) for task, operator, verdict, _ in checked if verdict != "accepted"
    }
    verdicts = {"race1": "not accepted", "formula1": "undecided", "goal1": "undecided"}
    assert (len(checked), missed) == (
        12,
        {task: ("limited-skill", verdict) for task, verdict in verdicts.items()},
    )
    assert [severities.against(*numbers) for numbers in ((-1.0, 9.0), (1.0, 0.9), (1.0, 0.5))] == [
        "accepted",
        "undecided",
        "not accepted",
    ]


def test_the_spec_need_not_be_the_one_that_ran_last(tmp_path: Path) -> None:
    layout = write_results(tmp_path, methods=["human", "expert"]).layout
    (tmp_path / "tiny.yaml").write_text(json.dumps({**SPEC, "methods": ["human", "expert"]}))
    write_record(
        layout.run("20270101-000000-later-0000") / "plan.json", {"spec": "later", "cells": []}
    )
    assert len(list(severities.check(tmp_path / "tiny.yaml", tmp_path))) == 2
