"""The training of experts: episodes out of phase, a multiplier that follows whole episodes, and
going on after an interruption.
"""

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from tests.learning.recordings import Interrupted
from tests.learning.test_loops import Staggered
from wasp_cli.errors import ArtifactError
from wasp_cli.learning.configs.recorded import Bars, ExpertConfig
from wasp_cli.learning.lagrangian import LagrangianCallback, MultiplierRule
from wasp_cli.learning.privileged import EpisodeSums, evaluate_privileged
from wasp_cli.learning.vec_env import TaskVecEnv
from wasp_cli.models.policy import load_privileged
from wasp_cli.seeds import derive
from wasp_cli.stages.base import Job, no_progress
from wasp_cli.stages.expert import ExpertStage
from wasp_cli.tasks.make import make_task

TINY = ExpertConfig(
    interactions=600,
    envs=4,
    rollout=25,
    epochs=2,
    batch=50,
    hidden=(8,),
    evaluation_episodes=2,
    checkpoints=(0.25, 1.0),
    bars={"race1": Bars(least_return=1e6)},
    acceptance_episodes=2,
    extension=200,
    extensions=1,
)
"""Nobody reaches its bar: its one further training is always needed."""


def job(root: Path, progress: Any = no_progress, task: str = "race1") -> Job:
    for folder in (root / "out", root / "work"):
        folder.mkdir(parents=True, exist_ok=True)
    return Job(
        "expert", task, 0, TINY, {"action_repeat": 4}, {}, {}, root / "out", root / "work", progress
    )


def test_first_episodes_are_cut_at_their_share_of_the_time_limit_and_bootstrapped():
    # every episode terminates after 5 of at most 6
    env = TaskVecEnv(Staggered(3), 3, -1.0, 1.0, iter(itertools.count(3, 4)).__next__)
    env.spread = True
    env.reset()
    ends: dict[int, list[int]] = {0: [], 1: [], 2: []}
    for t in range(1, 15):
        env.step_async(np.ones((3, 2), np.float32))
        seen, _, done, infos = env.step_wait()
        for row in np.flatnonzero(done):
            cut = not ends[row] and row < 2  # the last row's share is the whole time limit
            ends[row].append(t)
            assert infos[row]["TimeLimit.truncated"] == cut
            assert infos[row]["terminal_observation"][1:].tolist() == ([t, 0] if cut else [5, 1])
            assert seen[row, 1] == 0
    assert ends == {0: [2, 7, 12], 1: [4, 9, 14], 2: [5, 10]}
    assert env.curve.returns == [5.0] * 6  # whole episodes only
    assert env.curve.env_steps == 4 * 3 * 14
    # every episode costs in its second decision; cut ones count here
    assert env.curve.costly_env_steps == 3 * (4 + 3 + 3)


def test_the_multiplier_follows_the_cost_over_an_episodes_length():
    """Rows in phase: rollouts of two decisions cost much or nothing in turn, and the mean over
    three of them does not.
    """
    env = TaskVecEnv(Staggered(2), 3, -1.0, 1.0, iter(itertools.count(3, 4)).__next__)
    rule = MultiplierRule(initial=0.5, rate=0.1, bound=10.0, limit=100.0)
    callback = LagrangianCallback(env, rule, 24, no_progress)
    PPO("MlpPolicy", env, n_steps=2, batch_size=4, n_epochs=1, device="cpu", seed=0).learn(
        24, callback=callback
    )
    costs = [row["cost_per_1000"] for row in callback.curve]
    assert costs == [375.0, 0.0, 0.0, 375.0, 0.0, 375.0]
    expected = 0.5
    for k, row in enumerate(callback.curve):
        assert row["multiplier"] == pytest.approx(expected), k
        expected = rule.next(expected, float(np.mean(costs[max(0, k - 2) : k + 1])))
    assert env.multiplier == pytest.approx(expected)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, Any]:
    root = tmp_path_factory.mktemp("trained")
    summary = ExpertStage().run(job(root))
    return root / "out", summary


@pytest.mark.slow
@pytest.mark.parametrize("rollouts", [1, 4, 7, 8])
def test_an_interrupted_training_ends_with_the_same_bytes(trained, tmp_path, rollouts):
    count = 0

    def interrupt(share: float, text: str) -> None:
        nonlocal count
        count += 1
        if count == rollouts:
            raise Interrupted

    with pytest.raises(Interrupted):
        ExpertStage().run(job(tmp_path, interrupt))
    assert not list((tmp_path / "out").iterdir())
    torch.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002
    shares: list[float] = []
    summary = ExpertStage().run(job(tmp_path, lambda share, text: shares.append(share)))
    assert len(shares) == 9 - rollouts  # six rollouts, two more; the interrupted one is made again
    whole, expected = trained
    assert summary == expected
    names = sorted(path.name for path in whole.iterdir())
    assert names == [
        "acceptance.json",
        "curve.json",
        "evaluation.json",
        "limit.json",
        "references.json",
        "skill-0.25.json",
        "skill-0.25.safetensors",
        "skill-1.json",
        "skill-1.safetensors",
    ]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    for name in names:
        assert (whole / name).read_bytes() == (tmp_path / "out" / name).read_bytes(), name


def test_a_damaged_state_is_named(tmp_path):
    root = job(tmp_path)
    (root.work_dir / "training.safetensors").write_bytes(b"not tensors")
    with pytest.raises(ArtifactError, match=r"training\.safetensors"):
        ExpertStage().run(root)


def test_the_artifact_says_how_every_checkpoint_does(trained):
    out, summary = trained
    evaluation = json.loads((out / "evaluation.json").read_text())
    assert list(evaluation) == ["0.25", "1"]
    judge = make_task("race1", 2, observe=("privileged",), action_repeat=4)
    sums = evaluate_privileged(
        judge,
        load_privileged(out, 1.0),
        [derive("expert-evaluation", "race1", 0, i) for i in range(2)],
    )
    assert evaluation["1"] == sums.statistics(1)
    assert summary["return"] == evaluation["1"]["return"]
    assert summary["return_at_0.25"] == evaluation["0.25"]["return"]
    rows = json.loads(
        (out / "curve.json").read_text(),
        parse_constant=lambda name: pytest.fail(f"{name} is no JSON"),
    )
    assert [row["interactions"] for row in rows] == [100.0 * (k + 1) for k in range(8)]
    assert rows[0]["multiplier"] == TINY.multiplier_init  # it acts from the first rollout
    asked = json.loads((out / "acceptance.json").read_text())
    assert [(row["interactions"], row["accepted"]) for row in asked] == [(600, False), (800, False)]
    fresh = [derive("expert-acceptance", "race1", 0, i) for i in range(2)]
    assert (
        asked[-1]["return"]
        == evaluate_privileged(judge, load_privileged(out, 1.0), fresh).statistics(1)["return"]
    )
    assert (summary["interactions"], summary["accepted"]) == (800, False)


def test_an_expert_that_reaches_its_bars_is_not_trained_on(tmp_path):
    easy = TINY.model_copy(update={"bars": {"race1": Bars(most_cost=1e6)}})
    summary = ExpertStage().run(dataclasses.replace(job(tmp_path), config=easy))
    assert (summary["interactions"], summary["accepted"]) == (600, True)


def test_statistics_of_episodes():
    sums = EpisodeSums(
        *(np.array(values, float) for values in ([1, 5], [30, 0], [10, 0], [7, 6], [1000, 500]))
    )
    assert sums.statistics(7) == {
        "return": 3.0,
        "return_sd": pytest.approx(np.sqrt(8)),
        "cost": 15.0,
        "cost_sd": pytest.approx(np.sqrt(450)),
        "goals": 6.5,
        "goals_sd": pytest.approx(np.sqrt(0.5)),
        "cost_per_1000": 20.0,
        "success": 0.5,
        "episodes": 2,
    }
    one = EpisodeSums(*(field[:1] for field in sums))
    assert one.statistics(7)["return_sd"] is None


def test_bars_are_asked_for_one_by_one():
    bars = Bars(least_return=18.0, most_cost=10.0)
    assert bars.reached(18.0, 0.0, 10.0)
    assert not bars.reached(17.9, 1.0, 0.0)
    assert not bars.reached(30.0, 1.0, 10.1)
    assert not Bars(least_success=0.68).reached(99.0, 0.67, 0.0)
    assert Bars().reached(-1.0, 0.0, 99.0)
