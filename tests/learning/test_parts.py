"""Parts of episodes: where a recording begins and ends, and that it is what the whole episode would have shown there."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.learning.test_dataset import files, job
from tests.learning.test_dataset import root as root  # a fixture
from tests.learning.test_loops import Staggered
from wasp_cli.errors import TaskError
from wasp_cli.learning.configs import DatasetConfig
from wasp_cli.learning.dataset import Parts, record
from wasp_cli.learning.parts import can_begin_later, lead, mean_decisions, whole_episodes
from wasp_cli.learning.shards import HELD_OUT, read_shards
from wasp_cli.stages import dataset as stage
from wasp_cli.tasks.make import make_task

SEEDS = [3, 4, 5, 6]


def fixed(moment: list[int]) -> Any:
    """Commands that depend on the decision alone, counted on by whoever shares the list."""

    def command(privileged: Any) -> Any:
        moment[0] += 1
        return np.tile(np.random.default_rng(moment[0]).uniform(-1, 1, 2), (len(privileged), 1)).astype(np.float32)

    return command


def test_a_part_is_what_the_whole_episode_shows_there() -> None:
    whole = record(make_task("race1", 4, observe=("pixels", "privileged")), SEEDS, fixed([0]), ["a"] * 4, 0)
    blind = make_task("race1", 4, observe=("privileged",))
    rows = np.array([True, False, False, False])
    parts = lead(blind, SEEDS, fixed([0]), rows, 40, np.random.default_rng(1))
    began = parts.begin["env_steps"] // 4
    assert began[0] == 0
    assert set(began.tolist()) <= {0, 40, 80, 120}
    assert len(set(began.tolist())) > 1
    assert parts.decisions.tolist() == [125, 40, 40, 40]
    for row, start in enumerate(began.tolist()):
        one = Parts(parts.begin, np.where(np.arange(4) == row, 30, 1))
        found = record(make_task("race1", 4, observe=("pixels", "privileged")), SEEDS, fixed([start]), ["a"] * 4, 7, one)
        mine, theirs = found.rows(found.episode == 7 + row), whole.rows(whole.episode == row)
        count = min(31, len(theirs.first) - start)
        assert len(mine.first) == count
        assert mine.first.tolist() == [1.0] + [0.0] * (count - 1), "the part begins as an episode does"
        assert (mine.action[0] == 0).all()
        assert mine.reward[0] == mine.cost[0] == 0
        for name in ("pixels", "privileged"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name)[start : start + count])
        for name in ("action", "reward", "cost", "cost_env", "sources", "goals", "terminal"):
            np.testing.assert_array_equal(getattr(mine, name)[1:], getattr(theirs, name)[start + 1 : start + count])
        others = [row_ for row_ in range(4) if row_ != row]
        assert all((found.episode == 7 + row_).sum() == 2 for row_ in others), "a row that is cut is recorded no longer"


class Restorable(Staggered):
    """Staggered with snapshots."""

    def snapshot(self) -> dict[str, Any]:
        return {"seed": self.seed.copy(), "t": self.t.copy(), "ended": self.over.copy()}

    def restore(self, snapshot: Any) -> Any:
        self.seed, self.t, self.over = snapshot["seed"].copy(), snapshot["t"].copy(), snapshot["ended"].copy()
        return self.see()


def test_every_part_that_an_episode_reaches_is_equally_likely() -> None:
    # Episodes of 2 to 5 decisions at a limit of 6: three parts of two, of which the third begins after four decisions.
    seeds = np.arange(4000)
    task: Any = Restorable(4000)
    parts = lead(task, seeds.tolist(), lambda seen: np.zeros((4000, 2)), np.zeros(4000, bool), 2, np.random.default_rng(0))
    begun = parts.begin["t"]
    assert not parts.begin["ended"].any(), "a part begins before the end"
    assert (task.t <= 4).all(), "nobody is driven beyond the last part"
    assert (task.t == 0).mean() == pytest.approx(1 / 3, abs=0.04), "and whoever records the first part is not driven at all"
    for length, expected in ((2, {0: 1.0}), (3, {0: 0.5, 2: 0.5}), (4, {0: 0.5, 2: 0.5}), (5, {0: 1 / 3, 2: 1 / 3, 4: 1 / 3})):
        mine = begun[2 + seeds % 4 == length]
        assert {value: pytest.approx(share, abs=0.06) for value, share in expected.items()} == {
            value: (mine == value).mean() for value in sorted(set(mine.tolist()))
        }


def test_whole_episodes_have_their_share_among_the_held_out_ones_too() -> None:
    chosen = whole_episodes(0.2, 400, np.random.default_rng(0))
    assert chosen.sum() == 80
    assert chosen[9::10].sum() == 8
    assert not whole_episodes(0.0, 20, np.random.default_rng(0)).any()
    assert whole_episodes(1.0, 20, np.random.default_rng(0)).all()


def test_the_mean_length_counts_whole_episodes_and_the_last_short_part() -> None:
    assert mean_decisions(None, 0.1, 250) == mean_decisions(300, 0.1, 250) == 250
    assert mean_decisions(50, 0.1, 250) == pytest.approx(0.1 * 250 + 0.9 * 50)
    assert mean_decisions(50, 0.0, 125) == pytest.approx(125 / 3)


def test_a_task_without_snapshots_is_recorded_whole(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Plain(Staggered):
        def snapshot(self) -> Any:
            raise TaskError("the environment has no 'snapshot'", "none")

    plain: Any = Plain(2)
    restorable: Any = Restorable(2)
    assert not can_begin_later(plain)
    assert can_begin_later(restorable)
    monkeypatch.setattr("wasp_cli.learning.parts.can_begin_later", lambda task: False)
    stage.DatasetStage().run(dataclasses.replace(job(root, "plain"), config=_parts(None)))
    stage.DatasetStage().run(dataclasses.replace(job(root, "refused"), config=_parts(50)))
    assert files(root / "plain").keys() == files(root / "refused").keys()
    assert read_shards(root / "refused").episode.tolist() == read_shards(root / "plain").episode.tolist()


def _parts(decisions: int | None) -> DatasetConfig:
    return DatasetConfig(steps=500, envs=3, decisions=decisions, whole_share=0.2)


def test_the_stage_records_more_layouts_for_the_same_steps(root: Path) -> None:
    stage.DatasetStage().run(dataclasses.replace(job(root, "in-parts"), config=_parts(20)))
    stage.DatasetStage().run(dataclasses.replace(job(root, "at-length"), config=_parts(None)))
    short, long = read_shards(root / "in-parts"), read_shards(root / "at-length")
    lengths, counts = np.unique(np.unique(short.episode, return_counts=True)[1] - 1, return_counts=True)
    assert set(lengths.tolist()) - {5, 20} <= {125}, "parts of twenty decisions, the last one of five, or whole episodes"
    assert counts[lengths == 125].sum() >= 1
    assert len(np.unique(short.episode)) >= 2 * len(np.unique(long.episode))
    assert short.first.sum() == len(np.unique(short.episode))
    assert short.held_out(HELD_OUT).any()
    again = dataclasses.replace(job(root, "in-parts-again"), config=_parts(20))
    stage.DatasetStage().run(again)
    assert files(root / "in-parts-again") == files(root / "in-parts")
