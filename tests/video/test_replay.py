"""`wasp replay`: an episode, or one decision, from a results folder to a picture."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import Result
from PIL import Image

from tests.commands import run_here
from tests.report.explained import Invented
from tests.video.replayed import CELL, EAGER, KEYS, TAU_R, WINDOW, made_store
from wasp_cli.errors import ArtifactError
from wasp_cli.metrics.episode import GATE_SAFETY
from wasp_cli.metrics.necessity import ALONE, ASSISTED, necessity
from wasp_cli.report.explain.episode import read_episode
from wasp_cli.store.artifact import commit, read_manifest, staging_folder
from wasp_cli.store.branches import BRANCHES_FILE, BranchedCell, write_branches
from wasp_cli.store.find import find_cell
from wasp_cli.store.layout import Layout
from wasp_cli.store.slim import Slimming, slim
from wasp_cli.store.tables import CellIdentity, Thresholds
from wasp_cli.video.replay import (
    Criterion,
    correction,
    criterion_of,
    default_name,
    judge,
    source_of,
)
from wasp_cli.video.trace import play_episode

LABEL = "race1 s0 wasp noisy=0.4"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_store(tmp_path_factory.mktemp("replay"))


@pytest.fixture
def copied(results: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(results, tmp_path / "results"))


def replayed(results: Path, *arguments: str | Path, code: int | None = None) -> Result:
    return run_here("replay", *arguments, "--results", results, columns=200, code=code)


def intervened(results: Path) -> tuple[int, int]:
    """Decisions of episode 1 with and without an intervention."""
    apart = read_episode(find_cell(Layout(results), CELL), 1).intervened
    return int(np.flatnonzero(apart)[0]), int(np.flatnonzero(~apart)[0])


@pytest.fixture
def published(results: Path, tmp_path: Path) -> Path:
    """The same in a folder of what `wasp publish --steps 1` leaves."""
    whole, part = Layout(results), Layout(tmp_path / "published")
    part.prepare()
    for kind, key in (KEYS | {"evaluate": CELL}).items():
        staging = staging_folder(part, key)
        shutil.copytree(whole.artifact(kind, key), staging, dirs_exist_ok=True)
        manifest = read_manifest(whole, kind, key)
        commit(
            part, kind, key, staging, {**manifest, "slim": slim(staging, kind, Slimming(steps=1))}
        )
    return part.root


# -- an episode ------------------------------------------------------------------------------------


def test_the_video_lies_in_the_current_folder_under_the_name_of_the_cell(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, threads = torch.get_num_threads(), []
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    monkeypatch.chdir(tmp_path)
    done = replayed(results, LABEL, "--episode", "1", "--every", "12")
    assert (done.exit_code, done.stdout) == (0, "race1_wasp_noisy-0.4_s0_e1.gif: 3 frames\n"), (
        done.output
    )
    video: Any = Image.open("race1_wasp_noisy-0.4_s0_e1.gif")
    assert video.n_frames == 3
    assert threads == [1, before] * 2, (
        "matrix products have those of evaluations, not those of the simulator"
    )


def test_the_corrected_future_is_that_of_the_stored_plan(results: Path) -> None:
    stored = read_episode(find_cell(Layout(results), CELL), 1)
    found = correction(stored)
    assert found.name == "with the plan"
    planned = [t for t, plan in enumerate(found.residuals) if plan is not None]
    assert planned
    for t in planned:
        assert found.residuals[t].shape == (EAGER["residual_steps"], 2)
        np.testing.assert_allclose(
            np.clip(stored.a_h[t] + found.residuals[t][0], -1, 1), stored.a[t], atol=1e-6
        )


def test_a_plan_that_was_dropped_is_no_correction(tmp_path: Path) -> None:
    made = Invented()
    made.fire(2, GATE_SAFETY)
    made.fire(4, GATE_SAFETY, residuals=((0.0, 0.0), (0.0, 0.0)))
    found = correction(made.read(tmp_path))
    assert [t for t, plan in enumerate(found.residuals) if plan is not None] == [2]


def test_of_a_method_without_plans_the_changed_action_is_the_correction(tmp_path: Path) -> None:
    made = Invented(method="diffusion", config={}, thresholds=Thresholds())
    made.a[3] = [-0.25, 0.5]
    stored = made.read(tmp_path)
    found = correction(stored)
    assert [t for t, plan in enumerate(found.residuals) if plan is not None] == [3]
    np.testing.assert_allclose(found.residuals[3], [[-0.75, 0.75]])
    assert found.name == "executed action, then commands"
    # of a method that imagines the expert behind every command
    made.config = {"search_rollouts": 1}
    assert correction(made.read(tmp_path)).name == "executed action, then the expert"
    assert default_name(stored, ".gif") == Path("goal1_diffusion_laggy-0.7_s0_e0.gif")


def test_the_first_episode_of_a_cell_published_in_part_plays_alone(
    published: Path, tmp_path: Path
) -> None:
    done = replayed(
        published, CELL, "--episode", "0", "--every", "20", "--out", tmp_path / "a.webp", code=0
    )
    assert "the episode is played alone" in done.stderr + done.stdout
    assert (tmp_path / "a.webp").stat().st_size > 1000


def test_of_an_episode_that_is_played_alone_only_the_commands_are_taken_as_recorded(
    published: Path,
) -> None:
    source = source_of(Layout(published), read_episode(find_cell(Layout(published), CELL), 0))
    assert source.alone
    said = source.recorded._replace(a_h=[-source.recorded.a_h[0]])
    play_episode(replace(source, recorded=said), 0, [None] * 999, [], 3, lambda share, doing: None)
    with pytest.raises(ArtifactError, match="command of the operator"):
        play_episode(
            replace(source, recorded=said, alone=False),
            0,
            [None] * 999,
            [],
            3,
            lambda share, doing: None,
        )
    other = source.recorded._replace(a=[-source.recorded.a[0]])
    with pytest.raises(ArtifactError):
        play_episode(
            replace(source, recorded=other), 0, [None] * 999, [], 3, lambda share, doing: None
        )


def test_other_episodes_and_branches_of_a_cell_published_in_part_are_refused(
    published: Path,
) -> None:
    replayable = "without --step its first episodes can"
    assert replayable in replayed(published, CELL, "--episode", "0", "--step", "3").stderr
    assert replayable not in replayed(published, CELL, "--episode", "1", "--step", "3").stderr
    for arguments, words in (
        (("1",), "the steps of episode 1 are not here"),
        (("0", "--step", "3"), "published without all of its steps"),
    ):
        assert words in replayed(published, CELL, "--episode", *arguments, code=2).stderr


def test_models_are_looked_for_where_they_are_published(
    published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run of published cells copies their rows, not their models."""
    rows = Path(shutil.copytree(published, tmp_path / "rows"))
    for kind in KEYS:
        shutil.rmtree(rows / "store" / kind)
    stored = read_episode(find_cell(Layout(rows), CELL), 0)
    monkeypatch.setattr("wasp_cli.video.replay.published_folder", lambda: published)
    assert source_of(Layout(rows), stored).world_model.is_relative_to(published)
    monkeypatch.setattr("wasp_cli.video.replay.published_folder", lambda: None)
    with pytest.raises(ArtifactError, match="world model of this cell cannot be used"):
        source_of(Layout(rows), stored)


# -- one decision ----------------------------------------------------------------------------------


def test_a_decision_is_judged_and_drawn(results: Path, tmp_path: Path) -> None:
    t, _ = intervened(results)
    done = replayed(
        results,
        CELL[:6],
        "-e",
        "1",
        "--step",
        str(t),
        "--out",
        tmp_path / "a.png",
        "--json",
        code=0,
    )
    found = json.loads(done.stdout)
    assert (found["step"], found["window"], found["tau_R"], found["intervened"]) == (
        t,
        WINDOW,
        TAU_R,
        True,
    )
    assert found["tau_R_from"] == "the calibration of the method"
    cost = [np.array([found[name]["cost"]], float) for name in ("alone", "assisted")]
    reward = [
        np.array([found[name]["reward"]], np.float32).astype(float)
        for name in ("alone", "assisted")
    ]
    expected = necessity(*cost, *reward, tau_R=TAU_R)  # type: ignore[misc]
    assert found["rho"] == pytest.approx(float(expected.rho[0]))
    assert found["delta_c"] == pytest.approx(float(expected.delta_c[0]))
    assert found["delta_r"] == pytest.approx(float(expected.delta_r[0]))
    assert found["unnecessary"] is bool(expected.unnecessary[0])
    assert Image.open(tmp_path / "a.png").size[0] > 800


def test_a_decision_without_an_intervention_says_so(results: Path, tmp_path: Path) -> None:
    _, t = intervened(results)
    done = replayed(results, LABEL, "-e", "1", "-s", str(t), "-o", tmp_path / "a.gif", code=0)
    assert "both branches are the same" in done.stdout
    assert "ΔC +0   ΔR +0.000" in done.stdout
    assert done.stdout.endswith(f"{tmp_path / 'a.gif'}\n")


@pytest.mark.parametrize(
    ("saved", "gained", "tau_R", "expected", "words"),
    [
        (True, -1.0, None, False, "it avoided cost"),
        (True, -1.0, 0.1, False, "it avoided cost"),
        (False, 0.5, 0.1, False, "it gained more"),
        (False, 0.05, 0.1, True, "counts as unnecessary"),
        (False, 0.5, None, None, "undefined"),
    ],
)
def test_the_verdict_is_eq_21(
    tmp_path: Path,
    saved: bool,
    gained: float,
    tau_R: float | None,
    expected: bool | None,
    words: str,
) -> None:
    made = Invented()
    made.a[2] = [1.0, 1.0]
    branches = {
        ASSISTED: {"cost": [False, False], "cost_env": [0, 0], "reward": [gained, 0.0]},
        ALONE: {"cost": [saved, False], "cost_env": [3 * saved, 0], "reward": [0.0, 0.0]},
    }
    found = judge(made.read(tmp_path), 2, Criterion(4, tau_R, "nobody"), branches)
    assert found.unnecessary is expected
    assert found.rho == (0.25 if saved else 0.0)
    assert words in found.lines()[1]


def test_tau_R_comes_from_the_cells_own_branches_before_the_calibration(copied: Path) -> None:
    layout, cell = Layout(copied), find_cell(Layout(copied), CELL)
    assert criterion_of(layout, cell) == Criterion(WINDOW, TAU_R, "the calibration of the method")
    for key, upstream in (("eeee5555eeee5555eeee", "another"), ("ffff6666ffff6666ffff", CELL)):
        staging = staging_folder(layout, key)
        identity = CellIdentity("race1", "wasp", "full", "noisy", 0.4, 0)
        write_branches(
            staging / BRANCHES_FILE,
            BranchedCell(identity, 7, 1, 0.5 if upstream == CELL else 9.0, 2),
            [],
        )
        commit(
            layout,
            "counterfactual",
            key,
            staging,
            {"kind": "counterfactual", "key": key, "upstream": {"evaluate": upstream}},
        )
    assert criterion_of(layout, cell) == Criterion(
        7, 0.5, "the counterfactual branches of the cell"
    )
    shutil.rmtree(copied / "store" / "counterfactual")
    (layout.artifact("calibration", KEYS["calibration"]) / "calibration.json").write_text("{")
    assert criterion_of(layout, cell).tau_R is None


# -- what can go wrong -----------------------------------------------------------------------------


def with_fact(results: Path, place: tuple[str, ...], value: object) -> None:
    """The cell's manifest says something else."""
    file = results / "store" / "evaluate" / CELL / "_manifest.json"
    manifest = part = json.loads(file.read_text())
    for name in place[:-1]:
        part = part[name]
    part[place[-1]] = value
    file.write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([LABEL, "-e", "7"], "this cell has the episodes 0 to 1"),
        ([LABEL, "-e", "0", "-s", "25"], "episode 0 has the decisions 0 to 24"),
        (["race1 s0 wasp noisi=0.4", "-e", "0"], "did you mean"),
        ([LABEL, "-e", "0", "--out", "a.mp4"], "endings: .gif, .png, .apng, .webp"),
        ([LABEL, "-e", "0", "--out", "nowhere/a.gif"], "create the folder 'nowhere'"),
        ([LABEL, "-e", "0", "--every", "0"], "Invalid value for '--every'"),
        ([LABEL, "-e", "0", "--json"], "--json needs --step"),
        ([LABEL, "-e", "0", "-s", "1", "--every", "2"], "--every cannot be used with --step"),
        ([LABEL], "Missing option"),
    ],
)
def test_wrong_usage_ends_with_2_before_anything_is_played(
    arguments: list[str], expected: str, results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wasp_cli.video.trace.Source.world", lambda self: pytest.fail("played"))
    done = replayed(results, *arguments)
    assert (done.exit_code, done.stdout) == (2, "")
    assert expected in done.stderr


def test_a_cell_without_a_manifest_says_what_is_missing(results: Path, tmp_path: Path) -> None:
    for name in ("episodes.parquet", "_steps.pq"):
        shutil.copy(results / "store" / "evaluate" / CELL / name, tmp_path / name)
    done = replayed(
        results, tmp_path / "episodes.parquet", "-e", "0", "-o", tmp_path / "a.gif", code=2
    )
    assert "does not say how it was evaluated" in done.stderr
    assert "--results" in done.stderr


def broken_bytes(results: Path) -> None:
    path = results / "store" / "world_model" / KEYS["world_model"] / "world_model.safetensors"
    whole = bytearray(path.read_bytes())
    whole[-1] ^= 1
    path.write_bytes(whole)


def gone(results: Path) -> None:
    shutil.rmtree(results / "store" / "policies" / KEYS["policies"])


@pytest.mark.parametrize(
    ("harm", "expected"),
    [
        (broken_bytes, "the world model of this cell cannot be used"),
        (gone, "the policies of this cell cannot be used: no artifact"),
    ],
)
def test_models_that_are_not_there_end_with_1(
    copied: Path, tmp_path: Path, harm: Callable[[Path], None], expected: str
) -> None:
    harm(copied)
    done = replayed(copied, LABEL, "-e", "0", "-o", tmp_path / "a.gif")
    assert (done.exit_code, done.stdout) == (1, "")
    assert expected in done.stderr
    assert "run the spec of the cell again" in done.stderr
    assert not (tmp_path / "a.gif").exists()


@pytest.mark.parametrize(
    "path", [("task",), ("axes", "value"), ("settings", "action_repeat"), ("upstream",)]
)
def test_a_manifest_with_something_odd_is_no_traceback(
    copied: Path, tmp_path: Path, path: tuple[str, ...]
) -> None:
    with_fact(copied, path, ["odd"])
    assert (
        "does not say how it was evaluated"
        in replayed(copied, LABEL, "-e", "0", "-o", tmp_path / "a.gif", code=2).stderr
    )


@pytest.mark.parametrize(
    ("place", "value", "expected"),
    [
        # another operator than the one who drove
        (("axes", "value"), 0.6, "is not the recorded one"),
        (("task",), "no_such_package:Env-v0", "no_such_package"),
    ],
)
def test_what_cannot_be_played_as_it_was_ends_with_1(
    copied: Path, tmp_path: Path, place: tuple[str, ...], value: object, expected: str
) -> None:
    with_fact(copied, place, value)
    assert expected in replayed(copied, LABEL, "-e", "0", "-o", tmp_path / "a.gif", code=1).stderr
    assert os.listdir(tmp_path) == ["results"]
