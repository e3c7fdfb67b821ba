"""What a session finds that was driven before, what it needs, and the order of its conditions,
without driving.
"""

import shutil
from collections import Counter
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.commands import run_here
from tests.drive.conftest import wanted
from tests.view.conftest import PUBLISHED, published_cells
from wasp_cli.drive import prepare as module
from wasp_cli.drive import record as records
from wasp_cli.drive.block import Cut
from wasp_cli.drive.desk import END, NEXT
from wasp_cli.errors import UsageError
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.spec.study import balanced_order
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.parquet import write_table
from wasp_cli.store.people import BEAT, SESSION_FILE, TIMING_FILE
from wasp_cli.store.records import read_record, write_record


def driven(results: Path, episodes: int, **told: Any) -> SimpleNamespace:
    """What a session of participant 1 with WASP leaves, without its rows."""
    layout, loaded = (
        Layout(results),
        wanted(results, "wasp", participant=1, episodes=episodes, session=0).loaded(),
    )
    ((_, node),) = lay_out_over(loaded.spec, layout, None).cells
    staging = staging_folder(layout, node.key)
    write_record(staging / SESSION_FILE, told)
    manifest = {
        "task": node.task,
        "seed": node.seed,
        "axes": dict(node.axes),
        "config": dict(node.config),
    }
    commit(layout, node.kind, node.key, staging, manifest)
    return SimpleNamespace(layout=layout, loaded=loaded)


def test_the_next_session_has_other_worlds_and_other_methods_the_same(tmp_path: Path) -> None:
    for name, episodes, expected in (("whole", 5, [1, 1, 1, 1]), ("ended early", 2, [0, 1, 0, 0])):
        driven(tmp_path / name, episodes, cut=[{"why": END, "before_episode": 2}])
        asked = [
            wanted(tmp_path / name, "wasp", participant=1, episodes=episodes)
            for episodes in (5, 2, 3, 8)
        ]
        assert [each.loaded().spec.seeds[0] for each in asked] == expected
    assert wanted(tmp_path / "whole", "human", participant=1).loaded().spec.seeds == (0,)


def test_a_study_and_what_is_driven_freely_stay_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        module, "run_spec", lambda *_: SimpleNamespace(require_complete=lambda: None)
    )
    monkeypatch.setattr(module, "require_whole", lambda *_: None)
    driven(tmp_path / "free", 2, spec="drive")
    with pytest.raises(UsageError, match="was driven for 'drive'"):
        wanted(tmp_path / "free", None, what="study", participant=1, episodes=None).prepared()
    there, again = (
        driven(tmp_path, 2, spec="study", study=True),
        wanted(tmp_path, "wasp", participant=1, episodes=2, session=0),
    )
    with pytest.raises(UsageError, match="was driven for 'study'"):
        again.prepared()
    again.record(there)
    assert not there.layout.runs.exists(), "the report of free drives has no study"


def test_a_sitting_that_finishes_nothing_new_is_kept_too(tmp_path: Path) -> None:
    """Else the next sitting would offer a world again that this one skipped."""
    layout, loaded = Layout(tmp_path), wanted(tmp_path, episodes=30, session=0).loaded()
    ((_, node),) = lay_out_over(loaded.spec, layout, None).cells
    begun = shutil.copytree(
        PUBLISHED / "store" / "evaluate" / published_cells()["goal1 s1 human noisy=0.45"],
        tmp_path / "begun",
    )
    write_table(BEAT.empty_table(), begun / TIMING_FILE)
    write_record(begun / SESSION_FILE, {"cut": [], "sittings": []})
    for sitting in (1, 2, 3):
        record = records.CellRecord(
            layout,
            node,
            None,
            1,
            {},
            begun if sitting == 1 else layout.artifact(node.kind, node.key),
        )
        record.cut(Cut(7, 3, NEXT))
        record.publish("run", node)
        told = read_record(layout.artifact(node.kind, node.key) / SESSION_FILE)
        assert (record.finished, record.skipped, len(told["sittings"])) == (30, sitting, sitting)


def test_driving_a_task_trains_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "run_spec", lambda *_: pytest.fail("it trains"))
    monkeypatch.chdir(tmp_path)
    Path("race0").mkdir()  # no spec
    done = run_here("drive", "race0", "--results", "results", columns=400)
    assert (done.exit_code, Path("results").exists()) == (2, False), done.output
    assert (
        "train them first: wasp run drive --set 'tasks=[race0]' --set 'methods=[wasp]' --select"
        in done.stderr
    )


@pytest.mark.parametrize("conditions", range(1, 10))
def test_orders_are_balanced(conditions: int) -> None:
    """Every condition stands in every place, and follows every other one, equally often."""
    participants = conditions if conditions % 2 == 0 or conditions == 1 else 2 * conditions
    orders = [balanced_order(conditions, participant) for participant in range(participants)]
    assert all(sorted(order) == list(range(conditions)) for order in orders)
    places = Counter(
        (place, condition) for order in orders for place, condition in enumerate(order)
    )
    assert len(set(places.values())) == 1
    assert len(places) == conditions**2
    follows = Counter(pair for order in orders for pair in pairwise(order))
    assert len(follows) == conditions * (conditions - 1)
    assert len(set(follows.values())) <= 1
    assert balanced_order(conditions, participants) == orders[0], (
        "numbers beyond the square begin again"
    )
