"""A whole study by scripted participants, through the real socket: orders, questionnaires, the
report, withdrawal.
"""

from __future__ import annotations

import asyncio
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.commands import run_here
from tests.drive.conftest import asking, served, wanted
from wasp_cli.cells.runs import last_runs
from wasp_cli.drive.block import Block
from wasp_cli.drive.check import Habits, drive
from wasp_cli.drive.command import drive_session, withdrawn
from wasp_cli.drive.desk import END
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.report.summarize import TABLES
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held_if_free
from wasp_cli.store.people import SESSION_FILE
from wasp_cli.tasks.goal.task import Goal

pytestmark = pytest.mark.slow  # whole sessions

SPEC = """\
extends: table1
name: trial
tasks: [goal1]
methods: [human, ida]
operators: {noisy: null, laggy: null, limited-skill: null, reaction-time: null, person: {p1: 1, p2: 2}}
seeds: [0]
training_seed: 1
episodes: 1
side_by_side: 1
stages: []
reuse: published
study: {consent: "Agree?", consent_version: "3", practice: 1, speed: 4.0}
"""


@pytest.fixture(scope="module")
def trial(spec: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results folder of both participants; far faster than any person, so that most
    decisions of IDA are late.
    """

    def told(*_: object) -> None:
        raise AssertionError("what the commands alone lead to tells the conditions apart")

    results = tmp_path_factory.mktemp("trial") / "results"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Block, "review", told)
        patch.setattr(Goal, "num_steps", 200)  # 50 decisions
        for each in wanted(
            results, what=str(spec), method=None, speed=40.0, episodes=None, simulated=True
        ).everyone():
            drive_session(
                each.prepared(), 0, open_browser=False, scripted=Habits(each.participant or 0)
            )
    return results


def sessions(results: Path) -> list[dict[str, Any]]:
    found = [
        json.loads(path.read_text())
        for path in (Layout(results).store / "evaluate").glob(f"*/{SESSION_FILE}")
    ]
    return sorted(found, key=lambda each: (each["number"], each["block"]))


def test_everybody_drove_every_condition_in_an_order_of_their_own(trial: Path, spec: Path) -> None:
    found = sessions(trial)
    assert [(each["number"], each["block"]) for each in found] == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert all(
        each["simulated"] and each["consent"] == {"version": "3", "agreed": True} for each in found
    )
    for each in found:
        assert {name: len(scales) for name, scales in each["answers"].items()} == {
            "tlx": 6,
            "assistance": 3,
        }


def test_orders_are_shown_without_computing_anything(spec: Path, tmp_path: Path) -> None:
    found = run_here(
        "drive", spec, "--orders", "--results", tmp_path / "none", columns=None, code=0
    )
    assert [line.split() for line in found.stdout.splitlines()[1:]] == [
        ["p1", "Human-only", "IDA"],
        ["p2", "IDA", "Human-only"],
    ]
    assert not (tmp_path / "none").exists()
    assert (
        "nobody drives in 'quickstart'"
        in run_here("drive", "quickstart", "--orders", columns=200, code=2).stderr
    )


def test_the_report_has_measures_answers_order_and_timing(trial: Path) -> None:
    found = run_here("report", trial, "--no-trained", "--strict", columns=200, code=0)
    for words in (
        "measures by condition",
        "answers by condition",
        "effect of the order",
        "were decisions in time?",
        "SIMULATED",
    ):
        assert words in found.stdout
    assert "Claims" not in found.stdout, "the paper says nothing of people"
    assert (
        {"people", "questionnaires", "order", "timing"}
        <= {path.stem for path in (trial / "reports" / "trial").glob("*.csv")}
        <= set(TABLES)
    )
    page = (trial / "reports" / "trial" / "report.html").read_text()
    assert "Raw TLX" in page
    assert "NOT BALANCED" not in page


def test_who_stops_early_hides_nobody_and_is_asked_again(
    trial: Path, spec: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Goal, "num_steps", 80)  # 20 decisions
    layout, asked = Layout(tmp_path / "results"), list[str]()
    shutil.copytree(trial, layout.root, ignore=shutil.ignore_patterns("evaluate", "runs"))
    more: dict[str, Any] = {
        "what": str(spec),
        "episodes": 2,
        "simulated": True,
        "settings": ("study.practice=0",),
    }

    def sat(participant: int, requests: dict[int, str]) -> list[dict[str, Any]]:
        def answers(form: Mapping[str, Any]) -> dict[str, Any]:
            asked.append(form["name"])
            if asked == ["consent", "tlx"]:
                desk.ask(END)
                return {"scales": {}}
            return Habits(1).answers(form)

        session = wanted(layout.root, None, 40.0, participant=participant, **more).prepared()
        with served(session) as (desk, server, clock):
            asyncio.run(drive(server.address, asking(desk, requests), answers))
            clock.join(300)
        return session.done

    assert sat(1, {}) == []
    whole = {block["key"] for block in sat(1, {})}
    assert asked[2:] == ["consent", *2 * ["tlx", "assistance"]], (
        "what was driven and not asked is asked"
    )
    (part,) = sat(2, {1: END})
    planned = {cell.key for cell in last_runs(layout).runs["trial"].cells}
    assert (len(whole), whole <= planned, part["episodes"], len(sessions(layout.root))) == (
        2,
        True,
        1,
        3,
    ), "a report shows the last run"
    for participant in (1, 2):
        with pytest.raises(UsageError, match="was driven by a script"):
            wanted(
                layout.root, None, participant=participant, **more | {"simulated": False}
            ).prepared()


def test_a_plan_says_who_has_to_drive(spec: Path, tmp_path: Path) -> None:
    found = run_here("plan", spec, "--results", tmp_path / "none", columns=200)
    assert "4 cells wait for people" in found.stdout
    assert "critical path" not in found.stdout


def test_who_withdraws_leaves_no_row_and_no_unfinished_session(
    trial: Path, spec: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layout = Layout(trial)
    unfinished = layout.works / ("0" * 20)
    unfinished.mkdir(parents=True)
    (unfinished / SESSION_FILE).write_text('{"number": 2, "task": "goal1"}')
    told = {
        path.parent.name: json.loads(path.read_text())
        for path in (layout.store / "evaluate").glob(f"*/{SESSION_FILE}")
    }
    mine = next(key for key, each in told.items() if each["number"] == 2)
    film = trial / ".wasp-view" / "films" / f"{mine}-0-film"
    film.mkdir(parents=True)
    assert withdrawn(wanted(trial, participant=3)) == 0, "somebody else's"
    assert "nothing was deleted: participant 3 drove nothing of this" in capsys.readouterr().out
    for more, words in (
        (("--session", "1"), "deletes all that the participant drove"),
        (("--json",), "goes with neither"),
    ):
        assert (
            words
            in run_here(
                "drive",
                "goal1",
                "--participant",
                "2",
                *more,
                "--withdraw",
                "--results",
                trial,
                columns=200,
                code=2,
            ).output
        )
    with (
        held_if_free(layout.lock(unfinished.name)),
        pytest.raises(UsageError, match="participant 2 is driving now"),
    ):
        withdrawn(wanted(trial, participant=2))
    with pytest.raises(StoreError, match="no results in"):
        withdrawn(wanted(trial / "none", participant=2))
    assert withdrawn(wanted(trial, what=str(spec), method=None, episodes=None, participant=2)) == 3
    assert not film.exists()
    assert [each["number"] for each in sessions(trial)] == [1, 1]
    assert not unfinished.exists()
    assert "participant 2 has withdrawn: 3 results deleted" in capsys.readouterr().out
