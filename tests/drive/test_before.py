"""What a session finds that was driven before, and what it needs, without driving."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.commands import run_here
from tests.drive.conftest import wanted
from wasp_cli.drive import session as module
from wasp_cli.drive.desk import END
from wasp_cli.errors import UsageError
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.store.artifact import commit, staging_folder, write_record
from wasp_cli.store.layout import Layout
from wasp_cli.store.people import SESSION_FILE


def driven(results: Path, episodes: int, **told: Any) -> SimpleNamespace:
    """What a session of participant 1 with WASP leaves, without its rows."""
    layout, loaded = Layout(results), wanted(results, "wasp", participant=1, episodes=episodes, session=0).loaded()
    ((_, node),) = lay_out_over(loaded.spec, layout, None).cells
    staging = staging_folder(layout, node.key)
    write_record(staging / SESSION_FILE, told)
    manifest = {"task": node.task, "seed": node.seed, "axes": dict(node.axes), "config": dict(node.config)}
    commit(layout, node.kind, node.key, staging, manifest)
    return SimpleNamespace(layout=layout, loaded=loaded)


def test_the_next_session_has_other_worlds_and_other_methods_the_same(tmp_path: Path) -> None:
    for name, episodes, expected in (("whole", 5, [1, 1, 1, 1]), ("ended early", 2, [0, 1, 0, 0])):
        driven(tmp_path / name, episodes, cut=[{"why": END, "before_episode": 2}])
        asked = [wanted(tmp_path / name, "wasp", participant=1, episodes=episodes) for episodes in (5, 2, 3, 8)]
        assert [each.loaded().spec.seeds[0] for each in asked] == expected
    assert wanted(tmp_path / "whole", "human", participant=1).loaded().spec.seeds == (0,)


def test_a_study_and_what_is_driven_freely_stay_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "run_spec", lambda *_: SimpleNamespace(require_complete=lambda: None))
    monkeypatch.setattr(module, "require_whole", lambda *_: None)
    driven(tmp_path / "free", 2, spec="drive")
    with pytest.raises(UsageError, match="was driven for 'drive'"):
        wanted(tmp_path / "free", None, what="study", participant=1, episodes=None).prepared()
    there, again = driven(tmp_path, 2, spec="study", study=True), wanted(tmp_path, "wasp", participant=1, episodes=2, session=0)
    with pytest.raises(UsageError, match="was driven for 'study'"):
        again.prepared()
    again.record(there)
    assert not there.layout.runs.exists(), "the report of free drives has no study"


def test_driving_a_task_trains_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "run_spec", lambda *_: pytest.fail("it trains"))
    monkeypatch.chdir(tmp_path)
    Path("race0").mkdir()  # no spec
    done = run_here("drive", "race0", "--results", "results", columns=400)
    assert (done.exit_code, Path("results").exists()) == (2, False), done.output
    assert "train them first: wasp run drive --set 'tasks=[race0]' --set 'methods=[wasp]' --select" in done.stderr
