"""Operators who know more than assistants perceive: what they intend in the task, and what is imagined of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.artifacts import tiny_expert
from wasp_cli.models.policy import load_privileged
from wasp_cli.operators.base import DrawnNoise, EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.operators.informed import InformedOperator, Knowledge, operator_in
from wasp_cli.operators.mixed import MixedOperator
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.tasks.goal.two import TwoGoals

ROWS, STEPS = 3, 6
LADDER = {"noisy": 0.4, "laggy": 0.7, "limited-skill": 0.25, "reaction-time": 0.24, "noisy-gaussian": 0.5, "noisy-burst": 0.4,
          "delayed-noisy": 0.3, "reactive": 0.8, UNIMPAIRED: None}  # fmt: skip
SIMULATED = [name for name in OPERATORS if OPERATORS[name].simulated] + [UNIMPAIRED]


@pytest.fixture(scope="module")
def expert(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_expert(tmp_path_factory.mktemp("expert"), TwoGoals(1, observe=()).privileged_size)


def skill(fraction: float):
    """A latent policy that is no privileged one."""
    return lambda features: (features[:, :2] * fraction).tanh()


def world() -> TwoGoals:
    task = TwoGoals(ROWS, observe=())
    task.reset(range(ROWS))
    return task


class Both:
    """An informed operator in a task, and one of the same rule who is told beforehand what to intend."""

    def __init__(self, variant: str, expert: Path) -> None:
        self.task = world()
        value = LADDER[variant]
        self.operator = operator_in(self.task, skill, variant, value, EpisodeNoise(range(ROWS)), expert)
        policy = load_privileged(expert, 0.25 if variant == "limited-skill" else 1.0)
        context = OperatorContext(lambda fraction: policy, 2, self.task.decision_seconds)
        self.other = build_operator(variant, value, context, EpisodeNoise(range(ROWS)), ROWS)

    def command(self) -> tuple[Tensor, Tensor]:
        features = torch.randn(ROWS, 7)
        with torch.inference_mode():
            pair = self.operator.command(features), self.other.command(torch.from_numpy(self.task.privileged()))
        executed = pair[0].clamp(-1, 1) * 0.5
        for operator in (self.operator, self.other):
            operator.observe(executed)
        self.task.step(executed.numpy())
        return pair


@pytest.mark.parametrize("variant", SIMULATED)
def test_in_the_task_it_follows_the_privileged_policy_with_its_own_mistakes(variant: str, expert: Path) -> None:
    both = Both(variant, expert)
    for _ in range(STEPS):
        ours, theirs = both.command()
        assert torch.equal(ours, theirs)
    kept, world = both.operator.snapshot(), both.task.snapshot()
    future = [both.command()[0] for _ in range(STEPS)]
    both.operator.restore(kept)
    both.task.restore(world)
    assert all(torch.equal(both.operator.command(torch.zeros(ROWS, 7)), again) for again in future[:1])


@pytest.mark.parametrize("variant", SIMULATED)
def test_in_imagination_it_follows_the_latent_policy_from_its_real_memory(variant: str, expert: Path) -> None:
    """As an operator would who followed the latent policy, and had the same memory."""
    both = Both(variant, expert)
    for _ in range(STEPS):
        both.command()
    value = LADDER[variant]
    context = OperatorContext(skill, 2, both.task.decision_seconds)
    assumed = build_operator(variant, value, context, EpisodeNoise(range(ROWS)), ROWS)
    assumed.memory = {name: memory.clone() for name, memory in both.operator.memory.items()}
    rows, draws = torch.tensor([2, 0]), torch.rand(STEPS, 4, both.operator.draws)
    assert both.operator.draws == assumed.draws
    mine, theirs = (each.fork(rows, 2, DrawnNoise(draws)) for each in (both.operator, assumed))
    for _ in range(STEPS):
        features = torch.randn(4, 7)
        issued = mine.command(features)
        assert torch.equal(issued, theirs.command(features))
        for fork in (mine, theirs):
            fork.observe(issued * 0.5)
    again = mine.fork(torch.tensor([1]), 1, DrawnNoise(draws[:, :1]))
    assert not isinstance(again, InformedOperator)


def test_new_episodes_begin_without_memory(expert: Path) -> None:
    both = Both("reaction-time", expert)
    for _ in range(STEPS):
        both.command()
    both.operator.reset(torch.tensor([True, False, False]))
    queue = both.operator.memory["queue"]
    assert (queue[0] == 0).all()
    assert (queue[1:] != 0).any()


def test_operators_of_tasks_that_tell_nothing_are_what_they_were() -> None:
    operator = operator_in(world(), skill, "laggy", 0.5, EpisodeNoise(range(ROWS)))
    assert type(operator) is OPERATORS.load("laggy")
    assert operator.informed is None


def test_a_person_knows_what_a_person_knows(expert: Path) -> None:
    operator = operator_in(world(), skill, "person", 1.0, EpisodeNoise(range(ROWS)), expert)
    assert type(operator) is OPERATORS.load("person")


def test_a_mixture_that_nobody_imagines_takes_its_skills_from_the_task(expert: Path) -> None:
    """As SafeRL-Res is trained: every row meets the command of its own operator, whatever the features are."""
    task = world()
    context = OperatorContext(Knowledge(expert, task).at, 2, task.decision_seconds)
    noise = EpisodeNoise(range(ROWS))
    operators: list[Operator] = [build_operator("limited-skill", value, context, noise, ROWS) for value in (0.25, 1.0)]
    mixed = MixedOperator(operators, noise, seed=0)
    mixed.choice = torch.tensor([0, 1, 0])
    told = torch.from_numpy(task.privileged())
    wanted = torch.stack([load_privileged(expert, value)(told) for value in (0.25, 1.0)])
    issued = mixed.command(torch.zeros(ROWS, 7))
    assert torch.equal(issued, torch.stack([wanted[0, 0], wanted[1, 1], wanted[0, 2]]))
    assert not np.allclose(wanted[0].numpy(), wanted[1].numpy())
