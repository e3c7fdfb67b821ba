"""A participant's clone: fitted to recorded commands, an operator of the grid, and who
continues a session in its branches.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.commands import run_here
from tests.drive.conftest import harmed, swept_before_commit, wanted
from wasp_cli.cells.runs import last_runs
from wasp_cli.drive import clone as module
from wasp_cli.drive.check import Habits
from wasp_cli.drive.clone import fitted_mixture, judged, mixture_density, together
from wasp_cli.drive.command import drive_session
from wasp_cli.errors import UsageError
from wasp_cli.learning.clone import Issued
from wasp_cli.models.clone import Clone
from wasp_cli.operators.base import DrawnNoise, EpisodeNoise, OperatorContext, build_operator
from wasp_cli.operators.cloned_person import CloneOfPerson, ContinuedPerson
from wasp_cli.operators.clones import PlacedClone, placed
from wasp_cli.store.artifact import exists, read_manifest
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.goal.task import Goal

SPEC = """\
extends: table1
name: beside
tasks: [goal1]
methods: [ida]
operators: {noisy: null, laggy: null, limited-skill: null, reaction-time: null, person: {p7: 7}, cloned: {p7: 7}}
seeds: [0]
training_seed: 1
episodes: 2
side_by_side: 1
stages: [counterfactual]
counterfactual: {stride: 20, window: 5}
reuse: published
"""


def wasp(*arguments: object, code: int | None = None) -> Any:
    return run_here(*map(str, arguments), columns=200, code=code)


@pytest.fixture(scope="module", autouse=True)
def two_are_enough() -> Iterator[None]:
    """Of two episodes one is learned from and one held out; they end after 100 decisions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Goal, "num_steps", 400)
        patch.setattr(module, "FEWEST", 2)
        patch.setattr(module, "HELD_OUT", 2)
        yield


@pytest.fixture(scope="module")
def cloned(spec: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The results folder of two episodes, and what `wasp clone` says of them."""
    results = tmp_path_factory.mktemp("clone") / "results"
    asked = wanted(
        results,
        what=str(spec),
        method=None,
        speed=5.0,
        episodes=None,
        participant=7,
        simulated=True,
    )
    drive_session(asked.prepared(), 0, open_browser=False, scripted=Habits(7))
    with swept_before_commit(module):
        found = wasp(
            "clone", results, "--participant", 7, "--json", "--set", "clone.updates=100", code=0
        )
    (said,) = json.loads(found.stdout)
    return results, said


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["policies", "evaluate"])
def test_a_clone_of_what_is_damaged_is_refused(
    kind: str, cloned: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    results = shutil.copytree(cloned[0], tmp_path / "results")
    layout = Layout(results)
    shutil.rmtree(layout.artifact("clone", cloned[1]["key"]))
    key = cloned[1]["cells"][0]
    if kind != "evaluate":
        key = read_manifest(layout, "evaluate", key)["upstream"][kind]
    victim = harmed(layout, kind, key)
    found = wasp("clone", results, "--participant", 7, "--set", "clone.updates=3", code=1)
    assert f"'{victim}' has other bytes than were stored" in " ".join(found.output.split())
    assert not layout.artifact("clone", cloned[1]["key"]).exists()
    assert exists(layout, kind, key) == (kind == "evaluate"), (
        "a model is computed again; what a person drove stays"
    )


@pytest.mark.slow
def test_a_clone_says_what_it_was_fitted_to_and_how_well(
    cloned: tuple[Path, dict[str, Any]],
) -> None:
    results, said = cloned
    assert said["label"] == "goal1 s1 clone person=7"
    assert (said["episodes"], said["heldout_episodes"], said["simulated"], len(said["cells"])) == (
        1,
        1,
        True,
        1,
    )
    models = said["models"]
    assert set(models) == {"clone", "repeat", "expert", "uniform"}
    assert models["clone"]["log_density"] > models["expert"]["log_density"] > -math.inf
    assert models["uniform"]["log_density"] == pytest.approx(-2 * math.log(2))
    assert (
        json.loads((Layout(results).artifact("clone", said["key"]) / "quality.json").read_text())[
            "models"
        ]
        == models
    )
    assert list(last_runs(Layout(results)).runs) == ["beside"], (
        "a report shows what was driven, not what a clone needs"
    )


@pytest.mark.slow
def test_it_drives_in_the_grid_and_continues_a_session(
    cloned: tuple[Path, dict[str, Any]], spec: Path, tmp_path: Path
) -> None:
    results = shutil.copytree(cloned[0], tmp_path / "results")
    # A clone of other settings is another one.
    assert (
        "goal1 s0 ida cloned=7"
        in wasp(
            "run", spec, "--results", results, "-j", "0", "--set", "clone.updates=100", code=0
        ).output
    )
    branched = {
        path.parent.name: read_branches(path)
        for path in (Layout(results).store / "counterfactual").glob(f"*/{BRANCHES_FILE}")
    }
    assert len(branched) == 2
    assert all(len(each.t) for each in branched.values())
    wasp(
        "replay",
        "goal1 s0 ida cloned=7",
        "-e",
        "0",
        "--every",
        "100",
        "--results",
        results,
        "--out",
        tmp_path / "film.webp",
        code=0,
    )
    again = wasp("clone", results, "--participant", 7, "--set", "clone.updates=100", code=2)
    assert "was computed from the clone that is there" in again.output
    assert "the participant's clone drives" in wasp("report", results, "--no-trained").output
    # Who withdraws leaves neither the clone behind, nor what it drove, nor the branches of either.
    assert (
        "5 results deleted"
        in wasp("drive", spec, "--participant", 7, "--withdraw", "--results", results).output
    )
    left = {path.parent.parent.name for path in Layout(results).store.glob("*/*/_manifest.json")}
    assert not left & {"evaluate", "counterfactual", "clone"}
    assert {"world_model", "policies"} <= left


@pytest.mark.slow
def test_made_again_it_has_the_same_bytes(
    cloned: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    results, said = tmp_path / "results", cloned[1]
    shutil.copytree(cloned[0], results)
    weights = Layout(results).artifact("clone", said["key"]) / "clone.safetensors"
    before = weights.read_bytes()
    assert (
        "the earlier one is replaced"
        in wasp("clone", results, "--participant", 7, "--set", "clone.updates=100", code=0).output
    )
    assert weights.read_bytes() == before


@pytest.mark.slow
def test_who_has_driven_nothing_cannot_be_cloned(cloned: tuple[Path, dict[str, Any]]) -> None:
    assert (
        "participant 3 has driven nothing"
        in wasp("clone", cloned[0], "--participant", 3, code=2).output
    )


@pytest.mark.slow
def test_of_too_few_episodes_nothing_is_learnt(
    cloned: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FEWEST", 3)
    found = wasp("clone", cloned[0], "--participant", 7, "--set", "clone.updates=299", code=2)
    assert "drove 2 episodes of goal1 with these models, and 3 are needed" in found.output


@pytest.mark.slow
def test_a_missing_clone_is_said(
    cloned: tuple[Path, dict[str, Any]], spec: Path, tmp_path: Path
) -> None:
    results = shutil.copytree(cloned[0], tmp_path / "results")
    shutil.rmtree(Layout(results).store / "clone")
    found = wasp(
        "run", spec, "--results", results, "-j", "0", "--select", "operator=cloned", code=1
    )
    assert "nobody has cloned participant 7" in found.output


def test_elsewhere_no_clone_is_known() -> None:
    context = OperatorContext(
        skill=lambda fraction: lambda f: f[:, :2], action_size=2, decision_seconds=0.08
    )
    with pytest.raises(UsageError, match="evaluations and their branches"):
        build_operator("cloned", 7.0, context, EpisodeNoise([1]), 1)


@pytest.mark.slow
def test_a_session_is_played_as_it_was_and_its_branches_by_the_clone(
    cloned: tuple[Path, dict[str, Any]],
) -> None:
    folder = Layout(cloned[0]).artifact("clone", cloned[1]["key"])
    width = json.loads((folder / "clone.json").read_text())["features"]
    context = OperatorContext(
        skill=lambda fraction: lambda f: f[:, :2].tanh(), action_size=2, decision_seconds=0.08
    )
    said = np.random.default_rng(0).uniform(-1, 1, (6, 2)).astype(np.float32)
    features = [
        torch.randn(1, width, generator=torch.Generator().manual_seed(t)) for t in range(10)
    ]
    with placed(PlacedClone(folder, {5: said})):
        person = build_operator("person", 7.0, context, EpisodeNoise([5]), 1)
    assert isinstance(person, ContinuedPerson)
    snapshots = []
    for t in range(6):
        np.testing.assert_array_equal(person.command(features[t])[0], said[t])
        snapshots.append(person.snapshot())
    # The clone itself, with the same memory and at the same place of its noise, goes on with the
    # same commands.
    with placed(PlacedClone(folder)):
        alone = build_operator("cloned", 7.0, context, EpisodeNoise([5]), 1)
    assert isinstance(alone, CloneOfPerson)
    # In imagination it is itself: a fork draws from the same clone, after the same command.
    alone.restore(snapshots[3])
    drawn = DrawnNoise(torch.rand(2, 4, alone.draws, generator=torch.Generator().manual_seed(3)))
    imagined = alone.fork(torch.tensor([0]), 4, drawn)
    assert torch.equal(imagined.memory["last"], torch.from_numpy(said[3]).expand(4, 2))
    assert imagined.command(features[4].expand(4, -1)).shape == (4, 2)
    for start in (2, 4):
        person.restore(snapshots[start])
        alone.restore(snapshots[start])
        for f in features[start + 1 :]:
            assert torch.equal(person.command(f), alone.command(f))


def test_the_shares_of_a_baseline_are_the_most_likely_ones() -> None:
    source = torch.Generator().manual_seed(1)
    near = 0.05 * torch.randn(4000, 2, generator=source)
    residual = torch.cat([near[:3200], 2 * torch.rand(800, 2, generator=source) - 1])
    spread, share = fitted_mixture(residual)
    assert share == pytest.approx(0.8, abs=0.03)
    torch.testing.assert_close(spread, torch.full((2,), 0.05), atol=0.005, rtol=0)
    best = mixture_density(residual, spread, share).mean()
    for other in (
        (1.1 * spread, share),
        (0.9 * spread, share),
        (spread, share - 0.05),
        (spread, share + 0.05),
    ):
        assert mixture_density(residual, *other).mean() < best


def test_judged_by_hand() -> None:
    """A driver who holds every command: the last one foretells it without an error."""
    command = torch.tensor([[1.0, 0.0]]).repeat(9, 1)
    episode = Issued(
        torch.zeros(9, 3), command, torch.cat([torch.full((1, 2), torch.nan), command[:-1]])
    )
    torch.manual_seed(0)
    found = judged(
        Clone(3, (4,), 2), lambda f: torch.zeros(len(f), 2), together([episode, episode]), episode
    )
    assert found["repeat"]["squared_error"] == 0.0
    assert found["expert"]["squared_error"] == 1.0
    assert found["uniform"]["squared_error"] == 1.0
    assert found["repeat"]["log_density"] > found["expert"]["log_density"]
