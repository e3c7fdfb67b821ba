"""Who drives which episode of a dataset, and the stage on a real task: it goes on after a kill,
and says what it collected.
"""

import itertools
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from tests.cells import DECISIONS, REPEAT, Evaluated, evaluated
from tests.learning.recordings import SOURCES, recording
from tests.learning.test_counterfactual import judge
from wasp_cli.learning.behaviours import Behaviour, Commander, behaviours
from wasp_cli.learning.configs import CounterfactualConfig, DatasetConfig, MixtureConfig
from wasp_cli.learning.contents import ALL, contents, contents_of, unseen_sources
from wasp_cli.learning.shards import cost_sources, read_shards, write_shard
from wasp_cli.metrics.necessity import ASSISTED
from wasp_cli.models.policy import PrivilegedPolicy, checkpoint_name
from wasp_cli.models.weights import save_weights
from wasp_cli.seeds import layout_seed
from wasp_cli.stages import dataset as stage
from wasp_cli.stages.base import Job, no_progress
from wasp_cli.store.branches import BRANCHES_FILE
from wasp_cli.store.slim import first_episodes
from wasp_cli.store.tables import (
    ADDED,
    TIMING,
    VERSION_KEY,
    read_episodes,
    read_steps,
    read_times,
    same_rows,
)
from wasp_cli.tasks.make import make_task

TASK = "race1"
ENVS, SHARDS = 3, 2


def job(root: Path, name: str, progress: Any = no_progress, work: str | None = None) -> Job:
    folders = [root / name, root / (work or f"{name}-work")]
    for folder in folders:
        folder.mkdir(exist_ok=True)
    config = DatasetConfig(steps=ENVS * SHARDS * DECISIONS - 8, envs=ENVS)
    return Job(
        "dataset",
        TASK,
        1,
        config,
        {"action_repeat": REPEAT},
        {},
        {"expert": root / "expert"},
        *folders,
        progress,
    )


def collected(folder: Path) -> Path:
    """An untrained expert, and the dataset of an undisturbed run in `whole`."""
    (folder / "expert").mkdir()
    torch.manual_seed(0)
    size = {"inputs": make_task(TASK, 1).privileged_size, "hidden": [4], "action": 2}
    for fraction in (0.5, 1.0):
        save_weights(
            PrivilegedPolicy(**size), folder / "expert" / checkpoint_name(fraction), **size
        )
    (folder / "expert" / "evaluation.json").write_text(json.dumps({"0.5": {}, "1": {}}))
    summary = stage.DatasetStage().run(job(folder, "whole"))
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


KILLED = """
import os, signal, sys
from pathlib import Path
from tests.cells import short_episodes
from tests.learning.test_dataset import job, stage

def kill(share, text):
    (Path(sys.argv[1]) / "killed-work" / "shard-0001.partial").write_bytes(b"half a sha")
    os.kill(os.getpid(), signal.SIGKILL)

with short_episodes():
    stage.DatasetStage().run(job(Path(sys.argv[1]), "killed", kill))
"""


@pytest.mark.slow
def test_a_killed_collection_goes_on_after_its_last_whole_shard_with_the_same_bytes(root):
    done = subprocess.run([sys.executable, "-c", KILLED, str(root)], timeout=600, check=False)
    assert done.returncode == -signal.SIGKILL
    kept = root / "killed-work" / "shard-0000.parquet"
    stamp = kept.stat().st_mtime_ns
    stage.DatasetStage().run(job(root, "resumed", work="killed-work"))
    assert kept.stat().st_mtime_ns == stamp, "the finished shard was not collected again"
    assert files(root / "resumed") == files(root / "whole")
    assert set(files(root / "whole")) == {
        "shard-0000.parquet",
        "shard-0001.parquet",
        "contents.json",
        "incidents.json",
    }


def test_the_stage_says_what_it_collected(root):
    table = json.loads((root / "whole" / "contents.json").read_text())
    summary = json.loads((root / "summary.json").read_text())
    data = read_shards(root / "whole")
    assert cost_sources(root / "whole") == make_task(TASK, 1).cost_sources
    assert summary["episodes"] == table[ALL]["episodes"] == ENVS * SHARDS
    assert summary["steps"] == len(data.first) - ENVS * SHARDS
    assert summary["costly_share"] == pytest.approx(data.cost.sum() / summary["steps"], abs=1e-4)
    assert ((data.sources > 0).any(1) == (data.cost > 0)).all(), "whatever costs has a source"
    assert (data.sources.max(1) <= data.cost_env).all()
    assert (data.cost_env <= data.sources.sum(1)).all()
    assert summary["sources_not_seen"] == len(unseen_sources(table))


def test_the_table_is_what_can_be_counted_by_hand():
    data = recording()  # episodes of 12, 9 and 15 rows: expert, noisy, expert
    table = contents(data, SOURCES)
    assert table[ALL]["episodes"] == 3
    assert table[ALL]["steps"] == 33
    assert set(table) == {ALL, "expert", "noisy"}
    mine = [row for row in range(36) if data.episode[row] in (0, 2)]
    expert = table["expert"]
    assert expert["steps"] == 25
    assert expert["share"] == pytest.approx(2 / 3)
    assert expert["return_per_episode"] == pytest.approx(
        sum(float(data.reward[row]) for row in mine) / 2, rel=1e-5
    )
    assert expert["goals_per_episode"] == sum(int(data.goals[row]) for row in mine) / 2
    assert expert["costly_share"] == pytest.approx(sum(float(data.cost[row]) for row in mine) / 25)
    assert expert["sources"][SOURCES[1]] == sum(data.sources[row, 1] > 0 for row in mine) / 25
    assert contents(data._replace(goals=0 * data.goals), SOURCES)[ALL]["with_goal"] == 0
    terminal = data.terminal.copy()
    terminal[11] = 1
    table = contents(data._replace(terminal=terminal), SOURCES)
    assert (table["expert"]["terminal"], table["noisy"]["terminal"]) == (0.5, 0.0)


def test_sources_that_never_cost_are_named(tmp_path):
    data = recording()
    data.cost[:] = np.arange(36) % 12 == 5
    data.sources[:, 1] = 0
    assert unseen_sources(contents(data, SOURCES)) == [SOURCES[1]]
    for number in (0, 1):
        write_shard(
            tmp_path / f"shard-{number:04d}.parquet",
            data.rows((data.episode == 2) == (number == 1)),
            SOURCES,
        )
    assert contents_of(tmp_path) == contents(data, SOURCES), "shard after shard as if all were one"


def test_drift_and_sticky_noise_add_what_they_say():
    kinds = [Behaviour("sticky", sticky=0.2), Behaviour("sticky", sticky=0.2, correlation=0.6)]
    rows = (
        Behaviour("plain"),
        Behaviour("drift", drift=-0.3),
        *(kind for kind in kinds for _ in range(400)),
    )
    driver = commander(*rows)
    for skill in driver._skills:
        for parameter in skill.parameters():
            parameter.data.zero_()
    issued = np.stack([driver.command(np.zeros((len(rows), 5), np.float32)) for _ in range(6)])
    assert (issued[:, 0] == 0).all()
    np.testing.assert_allclose(issued[:, 1], np.tile([0, -0.3], (6, 1)), rtol=1e-6)
    for noise, correlation in ((issued[:, 2:402], 0.9), (issued[:, 402:], 0.6)):
        np.testing.assert_allclose(noise.std((1, 2)), 0.2, rtol=0.1)
        lagged = [np.corrcoef(noise[t].ravel(), noise[t + 1].ravel())[0, 1] for t in range(5)]
        np.testing.assert_allclose(lagged, correlation, atol=0.07)


def test_behaviours_follow_their_shares():
    chosen = behaviours(MixtureConfig().model_dump(), 50, 4, np.random.default_rng(0))
    assert len(chosen) == 50
    counts = {name: sum(b.name == name for b in chosen) for name in MixtureConfig.model_fields}
    assert all(
        abs(counts[name] - 50 * share) < 1 for name, share in MixtureConfig().model_dump().items()
    )
    assert {
        b.skill for b in behaviours(MixtureConfig().model_dump(), 50, 1, np.random.default_rng(0))
    } == {-1, 0}


@pytest.mark.parametrize("seed", range(5))
def test_held_out_episodes_have_the_shares_of_all(seed):
    chosen = behaviours(MixtureConfig().model_dump(), 400, 4, np.random.default_rng(seed))
    held = chosen[9::10]
    for name, share in MixtureConfig().model_dump().items():
        assert abs(sum(b.name == name for b in held) - share * len(held)) <= 1
    assert {b.repeat for b in held if b.name == "careless"} == {0.9, 0.95}
    names = [b.name for b in chosen]
    assert len({"".join(names[i : i + 10]) for i in range(0, 400, 10)}) > 30, (
        "the order is random all the same"
    )


def commander(*rows: Behaviour) -> Commander:
    torch.manual_seed(0)
    skills = [PrivilegedPolicy(5, [4], 2), PrivilegedPolicy(5, [4], 2)]
    return Commander(skills, rows, 2, np.random.default_rng(0))


def test_commands_do_what_their_behaviour_says():
    rows = (
        Behaviour("plain"),
        Behaviour("early", skill=0),
        Behaviour("frozen", repeat=1.0),
        Behaviour("random", replace=1.0),
        Behaviour("delayed", delay=2),
    )
    driver = commander(*rows)
    random = np.random.default_rng(1)
    seen = [random.normal(size=(5, 5)).astype(np.float32) for _ in range(6)]
    issued = np.stack([driver.command(s) for s in seen])
    expert, early = (
        driver._skills[i](torch.from_numpy(np.stack(seen))).detach().numpy() for i in (-1, 0)
    )
    np.testing.assert_allclose(issued[:, 0], expert[:, 0], rtol=1e-5)
    np.testing.assert_allclose(issued[:, 1], early[:, 1], rtol=1e-5)
    assert (issued[:, 2] == issued[0, 2]).all()  # a lag repeats from the second command on
    assert len({tuple(a) for a in issued[:, 3]}) == 6
    assert (issued[:2, 4] == 0).all()
    np.testing.assert_allclose(issued[2:, 4], expert[:-2, 4], rtol=1e-5)
    assert np.abs(issued).max() <= 1


def test_bursts_are_held():
    driver = commander(Behaviour("bursts", burst=1.0))
    issued = [tuple(driver.command(np.zeros((1, 5), np.float32))[0]) for _ in range(60)]
    runs = [len(list(group)) for _, group in itertools.groupby(issued)][:-1]
    assert min(runs[::2]) >= 2
    assert max(runs[::2]) <= 11
    # the intended command stands for one step before the next burst may begin
    assert set(runs[1::2]) == {1}


# Cells in batches of episodes: what a cell of fewer has is taken over, and nothing comes out
# differently.


# IDA that intervenes at some decisions, and not at others, although nothing is trained
EAGER = {"vote": 0.0}


@pytest.fixture(scope="module")
def whole(inputs, tmp_path_factory) -> Evaluated:
    return evaluated(
        inputs, tmp_path_factory.mktemp("whole"), "ida", EAGER, episodes=5, side_by_side=2
    )


@pytest.fixture
def begun(monkeypatch) -> list[int]:
    """Numbers of the episodes that begin."""
    numbers: list[int] = []

    def seed(task: str, number: int, episode: int) -> int:
        numbers.append(episode)
        return layout_seed(task, number, episode)

    monkeypatch.setattr("wasp_cli.seeds.layout_seed", seed)
    return numbers


def test_a_cell_goes_on_where_whole_batches_of_one_of_fewer_episodes_end(
    whole, inputs, tmp_path, begun
):
    fewer = evaluated(inputs, tmp_path / "fewer", "ida", EAGER, episodes=3, side_by_side=2)
    begun.clear()
    resumed = evaluated(
        inputs,
        tmp_path / "resumed",
        "ida",
        EAGER,
        episodes=5,
        side_by_side=2,
        earlier=fewer.path.parent,
    )
    assert set(begun) == {2, 3, 4}
    assert same_rows(whole.path, resumed.path)
    names = [name for name in pq.read_schema(whole.path).names if name not in TIMING]
    assert pq.read_table(whole.path, columns=names).equals(
        pq.read_table(resumed.path, columns=names)
    )
    for e in (0, 1):  # their times are those of the first time
        assert read_times(resumed.path)[e].tolist() == read_times(fewer.path)[e].tolist()


def test_rows_of_an_earlier_version_are_not_continued(inputs, tmp_path, begun):
    """They lack columns, which would then be means over the other episodes alone."""
    fewer = evaluated(inputs, tmp_path / "fewer", "ida", EAGER, episodes=2, side_by_side=2)
    table = pq.read_table(fewer.path).drop_columns([*ADDED])
    pq.write_table(
        table.replace_schema_metadata({VERSION_KEY: b"3"}), fewer.path, write_page_checksum=True
    )
    begun.clear()
    again = evaluated(
        inputs,
        tmp_path / "again",
        "ida",
        EAGER,
        episodes=3,
        side_by_side=2,
        earlier=fewer.path.parent,
    )
    assert set(begun) == {0, 1, 2}
    assert read_episodes([again.path])["int_eff"].null_count == 0


def test_a_cell_that_is_cut_after_whole_batches_is_the_one_of_fewer_episodes(
    whole, inputs, tmp_path
):
    fewer = evaluated(inputs, tmp_path / "fewer", "ida", EAGER, episodes=4, side_by_side=2)
    copy = shutil.copytree(whole.path.parent, tmp_path / "cut")
    summary = first_episodes(copy, 4)
    assert same_rows(copy / "episodes.parquet", fewer.path)
    means = {
        name: np.mean(pq.read_table(fewer.path)[name]) for name in ("return", "cost", "int_rate")
    }
    assert summary == {
        "return": round(means["return"], 2),
        "cost": round(means["cost"], 1),
        "int": round(means["int_rate"], 3),
    }


def test_the_branches_of_every_batch_come_back_in_it(whole, tmp_path):
    """What the recorded action earns is what it earned: bit for bit, in all batches."""
    summary = judge(whole, tmp_path, CounterfactualConfig(window=1), side_by_side=2)
    steps = {(step["episode"], step["t"]): step for step in read_steps(whole.path).to_pylist()}
    rows = [
        row
        for row in pq.read_table(tmp_path / BRANCHES_FILE).to_pylist()
        if row["branch"] == ASSISTED
    ]
    assert {row["episode"] for row in rows} == set(range(5))
    assert len(rows) == summary["interventions"]
    for row in rows:
        assert row["rewards"] == [steps[row["episode"], row["t"]]["reward"]]
