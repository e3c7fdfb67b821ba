"""Rounds of data: an assistant's own episodes, behind those of the dataset before."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.artifacts import tiny_artifacts
from wasp_cli.learning import rollouts
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.configs import ReturnsConfig, RolloutsConfig
from wasp_cli.learning.dataset import record
from wasp_cli.learning.rollouts import assisted_episodes, in_turn
from wasp_cli.learning.shards import Recording, hand_over, read_shards, write_shard
from wasp_cli.methods.base import Parts
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext
from wasp_cli.operators.limited import LimitedSkillOperator
from wasp_cli.operators.noisy import NoisyOperator
from wasp_cli.stages.base import Job
from wasp_cli.stages.rollouts import RolloutsStage
from wasp_cli.tasks.make import make_task

EAGER = {
    "horizon": 4, "residual_steps": 2, "candidates": 12, "elites": 4, "feasible": 4, "iterations": 1, "probe": 12, "gate_rollouts": 1,
    "tau_c": 1.2, "tau_r": 0.0, "probe_with": "random",
}  # fmt: skip
"""WASP that intervenes although nothing is trained, in little time."""
LIMIT = 12
"""Decision steps of an episode here."""


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folders = tiny_artifacts(tmp_path_factory.mktemp("artifacts"))
    folders["dataset"] = folders["policies"].parent / "dataset"
    folders["dataset"].mkdir()
    for shard in range(2):
        still = record(short_task(2), [shard, 5], lambda seen: np.zeros((2, 2), np.float32), ["expert", "noisy"], 2 * shard)
        write_shard(folders["dataset"] / f"shard-{shard:04d}.parquet", still, ("hazards",))
    return folders


@pytest.fixture(scope="module")
def parts(artifacts: dict[str, Path]) -> Parts:
    return load_parts(artifacts, ReturnsConfig())


def short_task(batch: int, **_: Any) -> Any:
    task = make_task("goal1", batch, action_repeat=4, observe=("pixels", "privileged"))
    task.max_decisions = LIMIT
    return task


def test_operators_take_turns_and_begin_with_the_unimpaired_one(parts: Parts) -> None:
    ladder = {"noisy": (0.2, 0.4), "limited-skill": (0.25,)}
    mixed = in_turn(ladder, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise([0] * 5), 5, first=6)
    assert [type(each) for each in mixed.operators] == [Operator, LimitedSkillOperator, NoisyOperator, NoisyOperator]
    assert mixed.choice.tolist() == [2, 3, 0, 1, 2]


def test_recorded_episodes_are_those_that_the_assistant_drove(parts: Parts) -> None:
    def fresh() -> tuple[Any, ...]:
        operator = in_turn(
            {"noisy": (0.4,), "laggy": (0.7,)}, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise([4, 5, 6]), 3, first=0
        )
        return short_task(3), parts.world_model, operator, build_assistant("wasp", EAGER, parts), [7, 8, 9], [1, 2, 3]

    loop = run_episodes(*fresh())
    found = assisted_episodes(*fresh(), "wasp", 40)
    assert np.abs(loop.action - loop.a_h).max() > 0.01, "the assistant never acted"
    assert found.behaviour.tolist() == ["wasp"] * len(found.first)
    for row in range(3):
        mine = found.rows(found.episode == 40 + row)
        assert len(mine.first) == LIMIT + 1
        np.testing.assert_array_equal(mine.action[1:], loop.action[:, row])
        np.testing.assert_array_equal(mine.reward[1:], loop.reward[:, row].astype(np.float32))
        np.testing.assert_array_equal(mine.cost_env[1:], loop.cost_env[:, row])
        assert mine.privileged.any()
        assert mine.pixels.any()


@pytest.fixture
def job(artifacts: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Job:
    # The stage makes its task itself.
    monkeypatch.setattr("wasp_cli.tasks.make.make_task", lambda name, batch, **options: short_task(batch, **options))
    config = RolloutsConfig(steps=60, envs=3, operators={"noisy": (0.6,)})
    axes = {"round": 2, "method": "wasp", "method_config": EAGER}
    settings = {"action_repeat": 4, "returns": ReturnsConfig()}
    for name in ("out", "work"):
        (tmp_path / name).mkdir()
    return Job("rollouts", "goal1", 0, config, settings, axes, artifacts, tmp_path / "out", tmp_path / "work")


def test_the_artifact_is_the_dataset_before_and_the_new_episodes(job: Job) -> None:
    summary = RolloutsStage().run(job)
    before, after = read_shards(job.inputs["dataset"]), read_shards(job.out_dir)
    rows = len(before.first)
    for name, value in before._asdict().items():
        np.testing.assert_array_equal(getattr(after, name)[:rows], value, err_msg=name)
    new = after.rows(np.arange(len(after.first)) >= rows)
    assert set(new.behaviour.tolist()) == {"wasp"}
    assert sorted(set(new.episode.tolist())) == [4, 5, 6, 7, 8, 9]  # two shards of three: 72 steps are the first to reach 60
    assert sorted(path.name for path in job.out_dir.glob("*.parquet")) == [f"shard-{i:04d}.parquet" for i in range(4)]
    assert os.stat(job.out_dir / "shard-0000.parquet").st_ino == os.stat(job.inputs["dataset"] / "shard-0000.parquet").st_ino
    contents = json.loads((job.out_dir / "contents.json").read_text())
    assert contents["wasp"]["episodes"] == 6
    assert (summary["own_steps"], summary["steps"]) == (6 * LIMIT, 10 * LIMIT)


def test_an_interrupted_round_goes_on_after_its_last_whole_shard(job: Job, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    whole = RolloutsStage().run(job)
    bytes_of = {path.name: path.read_bytes() for path in job.out_dir.iterdir()}
    calls: list[int] = []

    def broken(*arguments: Any, **options: Any) -> Recording:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return assisted_episodes(*arguments, **options)

    folders: Mapping[str, Path] = {name: tmp_path / name for name in ("out2", "work2")}
    for folder in folders.values():
        folder.mkdir()
    again = Job(**{**job.__dict__, "out_dir": folders["out2"], "work_dir": folders["work2"]})
    monkeypatch.setattr(rollouts, "assisted_episodes", broken)
    with pytest.raises(KeyboardInterrupt):
        RolloutsStage().run(again)
    assert [path.name for path in again.work_dir.iterdir()] == ["shard-0002.parquet"]
    assert RolloutsStage().run(again) == whole
    assert len(calls) == 3  # the first shard was not collected again
    assert {path.name: path.read_bytes() for path in again.out_dir.iterdir()} == bytes_of


def test_another_round_meets_other_worlds(job: Job, tmp_path: Path) -> None:
    RolloutsStage().run(job)
    (tmp_path / "third").mkdir()
    (tmp_path / "work3").mkdir()
    third = {"axes": {**job.axes, "round": 3}, "out_dir": tmp_path / "third", "work_dir": tmp_path / "work3"}
    RolloutsStage().run(Job(**{**job.__dict__, **third}))
    assert not np.array_equal(read_shards(job.out_dir).privileged, read_shards(tmp_path / "third").privileged)


def test_a_file_system_without_links_gets_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", refuse)
    (tmp_path / "a").write_bytes(b"shard")
    hand_over(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == b"shard"
