"""Which rounds the stage of the policies makes, and which it keeps. How well actors drive is
scripted; everything else is real.
"""

import copy
import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from tests.cells import REPEAT
from tests.learning.test_dataset import job as dataset_job
from wasp_cli.learning import policies, privileged, reinforce
from wasp_cli.learning.configs import PoliciesConfig
from wasp_cli.learning.privileged import evaluate_privileged
from wasp_cli.models.policy import LatentPolicy, Skills, load_skills
from wasp_cli.stages.expert_limit import LIMIT_FILE
from wasp_cli.stages.policies import PoliciesStage

CONFIG = PoliciesConfig(
    hidden=(8,),
    updates=3,
    batch=16,
    labelling_rounds=1,
    labelling_episodes=1,
    labelling_updates=3,
    evaluation_episodes=1,
)
GOOD = 1e6


class Run:
    """A run of the stage in which the latent drives have these returns, in their order, and
    reinforcement adds 1 to every weight.
    """

    def __init__(
        self,
        inputs: dict[str, Path],
        root: Path,
        patch: pytest.MonkeyPatch,
        returns: list[float],
        **changed: Any,
    ) -> None:
        self.judged: list[dict[str, Any]] = []
        self.began: dict[str, Any] | None = None
        self.limit = 0.0
        script = iter([*returns, 0.0, 0.0])  # the last two evaluate both skills

        def drive(task: Any, model: Any, skills: Skills, fraction: float, seeds: Any) -> Any:
            self.judged.append(copy.deepcopy(skills.state_dict()))
            zeros = np.zeros((250, len(seeds)))
            reward = zeros + next(script) / 250
            return SimpleNamespace(reward=reward, cost_env=zeros, goals=zeros, env_steps=zeros + 4)

        def better(
            actor: LatentPolicy, task: Any, model: Any, config: Any, limit: float, *rest: Any
        ) -> Any:
            self.began, self.limit = copy.deepcopy(actor.state_dict()), limit
            changed = copy.deepcopy(actor)
            with torch.no_grad():
                for parameter in changed.parameters():
                    parameter.add_(1.0)
            return changed, [{"interactions": 128.0, "return": float("nan")}]

        patch.setattr(policies, "latent_episodes", drive)
        patch.setattr(privileged, "evaluate_privileged", once)
        patch.setattr(reinforce, "reinforce", better)
        name = f"run{len(list(root.iterdir()))}"
        config = CONFIG.model_copy(update=changed)
        job = dataclasses.replace(
            dataset_job(root, name),
            kind="policies",
            config=config,
            settings={"action_repeat": REPEAT},
            inputs=inputs,
        )
        self.summary = PoliciesStage().run(job)
        self.folder = root / name
        self.evaluation = json.loads((self.folder / "evaluation.json").read_text())
        self.kept = load_skills(self.folder).state_dict()


SUMS: dict[tuple[int, ...], Any] = {}


def once(task: Any, policy: Any, seeds: list[int]) -> Any:
    """The episodes of the privileged policy, which are the same in every run."""
    drove = (hash(policy.net[0].weight.numpy().tobytes()), *seeds)
    if drove not in SUMS:
        SUMS[drove] = evaluate_privileged(task, policy, seeds)
    return SUMS[drove]


Start = Callable[..., Run]


@pytest.fixture
def start(chain, root, monkeypatch) -> Start:
    return lambda returns, **changed: Run(chain, root, monkeypatch, returns, **changed)


def stored(weights: torch.Tensor) -> torch.Tensor:
    return weights.half().float()


def same(a: dict[str, Any], b: dict[str, Any], skill: str = "") -> bool:
    """Whether the weights are the same in the precision in which they are kept."""
    return all(
        torch.equal(stored(value), stored(b[name]))
        for name, value in a.items()
        if name.startswith(skill)
    )


def test_a_round_that_reaches_the_bounds_ends_the_training(start):
    run = start([-GOOD, GOOD])
    assert run.began is None
    assert same(run.kept, run.judged[1])
    assert (run.summary["rounds"], run.summary["kept_round"], run.summary["reinforced"]) == (
        1,
        1,
        False,
    )
    assert not (run.folder / "reinforcement.json").exists()


def test_reinforcement_begins_with_the_best_round_and_changes_the_expert_alone(start):
    run = start([-GOOD, -2 * GOOD, GOOD])
    assert same({f"actors.1.{name}": value for name, value in run.began.items()}, run.judged[0])
    assert not same(run.judged[0], run.judged[1], "actors.1")
    assert same(run.kept, run.judged[0], "actors.0")
    assert torch.equal(
        run.kept["actors.1.net.0.weight"], stored(run.judged[0]["actors.1.net.0.weight"] + 1.0)
    )
    assert (run.summary["rounds"], run.summary["kept_round"], run.summary["reinforced"]) == (
        1,
        2,
        True,
    )
    last = run.evaluation["rounds"][-1]
    assert (last["reinforced"], last["cost_limit"]) == (128, run.limit)
    assert run.limit >= 1.25 * 1000 / 1000, (
        "the privileged cost, and half of what is always allowed"
    )
    text = (run.folder / "reinforcement.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == [{"interactions": 128.0, "return": None}]


def test_an_allowance_that_follows_from_the_expert_is_a_tenth_of_its_limit(
    chain, root, monkeypatch, tmp_path
):
    expert = tmp_path / "expert"
    shutil.copytree(chain["expert"], expert)
    (expert / LIMIT_FILE).write_text('{"cost_limit": 60.0}')
    returns, inputs = [-GOOD, -2 * GOOD, GOOD], {**chain, "expert": expert}
    followed = Run(inputs, root, monkeypatch, returns, cost_allowance="auto")
    written = Run(inputs, root, monkeypatch, returns, cost_allowance=6.0)
    assert followed.summary["cost_allowance"] == pytest.approx(6.0)
    assert "cost_allowance" not in written.summary
    assert followed.limit == pytest.approx(written.limit)
    assert followed.limit > Run(inputs, root, monkeypatch, returns).limit


def test_successes_are_counted_against_the_goals_of_the_task_to_the_end(start):
    for run in (start([GOOD]), start([-GOOD, -2 * GOOD, GOOD])):
        judged = [
            *run.evaluation["rounds"],
            *(s["latent"] for s in run.evaluation["skills"].values()),
        ]
        assert {(row["goals"], row["success"]) for row in judged} == {(0.0, 0.0)}


def test_a_reinforcement_that_made_it_worse_is_not_kept(start):
    run = start([-2 * GOOD, -GOOD, -3 * GOOD])
    assert run.began is not None
    assert same(run.kept, run.judged[1])
    assert (run.summary["kept_round"], run.summary["reinforced"]) == (1, False)


def test_without_interactions_nothing_is_reinforced(start):
    run = start([-GOOD, -GOOD], reinforce=CONFIG.reinforce.model_copy(update={"interactions": 0}))
    assert run.began is None
    assert len(run.evaluation["rounds"]) == 2
    assert set(run.evaluation["agreement"]) == {"0.5", "1"}


def test_labels_may_aim_higher_than_what_is_left_to_the_reinforcement(start):
    privileged = start([GOOD]).evaluation["judged_against"]["return"]
    near = privileged - 0.2 * abs(privileged)
    lenient = {"reinforce": CONFIG.reinforce.model_copy(update={"return_share": 0.75})}
    run = start([near, near], **lenient)
    assert run.evaluation["rounds"][0]["return_share"] == pytest.approx(0.8)
    assert len(run.evaluation["rounds"]) == 2, "the labels went on"
    assert run.began is None
    assert start([near, near, GOOD]).began is not None, (
        "by default it begins where the labels fell short"
    )
