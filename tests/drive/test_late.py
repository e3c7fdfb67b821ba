"""An assistant that is late is said to be late wherever its decisions are shown, and nobody
calls them misses.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.commands import run_here
from tests.drive.conftest import wanted
from wasp_cli.cells.runs import last_runs
from wasp_cli.drive import block
from wasp_cli.drive.check import Habits, Timing, checked_blocks, warning
from wasp_cli.drive.command import drive_session
from wasp_cli.drive.desk import GO, Desk, Held
from wasp_cli.errors import WaspError
from wasp_cli.methods.wasp.assistant import WASP
from wasp_cli.metrics.episode import GATE_LATE
from wasp_cli.store.layout import Layout
from wasp_cli.store.people import TIMING_FILE, read_timing
from wasp_cli.store.tables import cell_file, read_steps
from wasp_cli.tasks.goal.task import Goal

pytestmark = pytest.mark.slow  # sessions in real time


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    """Episodes end after 100 decisions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Goal, "num_steps", 400)
        yield


@pytest.fixture(scope="module")
def late(imported: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """The folder of an episode in which an assistant without any patience assists, its key, and
    what the terminal said.
    """
    results = shutil.copytree(imported, tmp_path_factory.mktemp("late") / "results")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(block, "PATIENCE", 1e-6)
        said: list[str] = []
        patch.setattr("wasp_cli.drive.command.plain", said.append)  # stdout is for --json
        asked = wanted(results, "wasp", 40.0, simulated=True)
        session = asked.prepared()
        summary = drive_session(session, 0, open_browser=False, scripted=Habits(0))
        asked.record(session)
    return results, summary["blocks"][0]["key"], "\n".join(said)


def test_late_is_a_gate_of_its_own_in_the_rows(late: tuple[Path, str, str]) -> None:
    marked, rows = _late(*late[:2]), cell_file(Layout(late[0]).artifact("evaluate", late[1]))
    gates, a_h, a = (np.array(read_steps(rows)[name].to_pylist()) for name in ("gate", "a_h", "a"))
    assert (a_h[marked] == a[marked]).all(), "the command is executed as it is"
    assert marked.sum() > 80
    assert (gates[marked] == GATE_LATE).all()
    assert not (gates[~marked] == GATE_LATE).any()


def test_the_end_of_the_session_the_table_and_explain_say_so(late: tuple[Path, str, str]) -> None:
    results, key, said = late
    assert "nobody assisted" in said
    assert "--speed 20" in said
    words = run_here("report", results, columns=None, code=0).output.split()
    assert f"WASP on Goal1: late in {_late(results, key).sum()} of 100 decisions" in " ".join(words)
    explain = ("explain", key, "--episode", "0", "--results", results)
    assert "no answer in time" in run_here(*explain, columns=None).output
    step = str(int(np.flatnonzero(_late(results, key))[0]))
    decision = run_here(*explain, "--step", step, columns=None).output
    assert "The assistant had not answered in time: the command was executed." in decision


def test_a_check_leaves_nothing_behind_and_hides_nothing(late: tuple[Path, str, str]) -> None:
    def there() -> tuple[set[Path], list[Any]]:
        layout = Layout(late[0])
        return {*late[0].rglob("*")}, last_runs(layout).runs["drive"].cells

    before = there()
    done = run_here(
        "drive",
        "goal1",
        "--method",
        "wasp",
        "--check",
        "--speed",
        "4",
        "--results",
        late[0],
        columns=80,
    )
    assert done.exit_code in (0, 1), done.output  # 1: decisions were late
    assert "99th percentile" in done.stdout
    assert "…" not in done.stdout
    assert all(len(line.rstrip()) <= 80 for line in done.stdout.splitlines()[:6])
    assert there() == before


def _late(results: Path, key: str) -> Any:
    return np.array(
        read_timing(Layout(results).artifact("evaluate", key) / TIMING_FILE)["late"].to_pylist()
    )


def driven(imported: Path, method: str, most: int, *keys: str) -> tuple[block.Block, block.Driven]:
    """The first decisions of an episode in which keys are held."""
    session = wanted(imported, method, 40.0).prepared()
    desk = Desk()
    desk.come()
    desk.held = Held(frozenset(keys))
    ((cell, node),) = session.blocks
    made = session.built(desk, cell, node, node.axes["method_config"])
    threading.Timer(0.2, desk.ask, (GO,)).start()
    try:
        found = made.episode(0, 0, 0, most=most)
    finally:
        made.close()
    assert isinstance(found, block.Driven)
    return made, found


def test_the_page_is_told_late_and_alone(imported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(block, "PATIENCE", 1e-6)
    late, alone = (
        [frame["gate"] for frame in driven(imported, method, 3)[1].frames[1:]]
        for method in ("wasp", "none")
    )
    assert "late" in late
    assert alone == ["alone"] * 3


def test_after_an_episode_the_second_drive_has_the_same_world_and_the_commands_alone(
    imported: Path,
) -> None:
    made, found = driven(imported, "wasp", 60, "ArrowUp", "ArrowLeft")
    review = made.review(found)
    assert review["driven"][0]["things"] == review["alone"][0]["things"]
    assert len(review["driven"]) == len(review["alone"]) == 61

    # What was executed, as commands alone, is what was driven: to the last digit.
    numbers = ("robot", "things", "cost", "costly", "goals", "return")
    found.trajectory = replace(found.trajectory, a_h=found.trajectory.a)
    again = made.review(found)["alone"]
    assert [{name: header[name] for name in numbers} for header in review["driven"]] == again
    assert not np.array_equal([h["robot"] for h in again], [h["robot"] for h in review["alone"]]), (
        "the assistant corrected something"
    )


def timing(**changes: Any) -> Timing:
    given: dict[str, Any] = {
        "label": "WASP",
        "period_ms": 80.0,
        "decisions": 250,
        "late_share": 0.016,
        "decision_ms": (20.0, 60.0),
        "input_ms": (70.0, 80.0),
        "round_trip_ms": (1.0, 2.0),
        "speed": 1.0,
        "recommended": 0.5,
        "pace": 1.0,
        "fired": 10,
        "fired_late_share": 0.0,
        "fired_ms": (60.0, 70.0),
    }
    return Timing(**given | changes)


def test_a_check_judges_the_decisions_at_which_a_gate_fires() -> None:
    assert timing().in_time
    assert not timing(fired_late_share=0.4).in_time, (
        "4 of 250 decisions are few, but they are those that matter"
    )
    assert not timing(pace=1.3).in_time
    assert (
        "a gate fired at 10 decisions: 60 ms (median), 70 ms (90th percentile), 0% late"
        in timing().where_gates_fired
    )


def test_a_session_begins_with_a_warning_where_decisions_are_late(
    imported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(block, "PATIENCE", 1e-6)
    monkeypatch.setattr("wasp_cli.drive.check.BRIEF", 5)
    told = warning(wanted(imported, "wasp", 1.0).prepared())
    assert "would keep it in time" in told
    assert warning(wanted(imported, "none", 1.0).prepared()) is None, (
        "nobody is late who is not there"
    )


def test_an_assistant_that_changes_the_command_in_place_ends_the_session(
    imported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decide = WASP.decide

    def changing(self: WASP, latent: Any, a_h: Any, operator: Any) -> Any:
        a_h *= 0.0
        a_h += 0.25
        return decide(self, latent, a_h, operator)

    monkeypatch.setattr(WASP, "decide", changing)
    with pytest.raises(WaspError, match="'WASP' changed the operator's command in place"):
        checked_blocks(wanted(imported, "wasp", 1.0).prepared(), 3)
