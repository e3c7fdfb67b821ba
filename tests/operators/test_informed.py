"""Operators who know more than assistants perceive: what they intend in the task, and what is
imagined of them.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.artifacts import tiny_expert
from wasp_cli.learning.closed_loop import privileged_view
from wasp_cli.learning.informed import informed_policies
from wasp_cli.models.policy import load_privileged
from wasp_cli.operators.base import (
    DrawnNoise,
    EpisodeNoise,
    Operator,
    OperatorContext,
    build_operator,
)
from wasp_cli.operators.mixed import MixedOperator
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.tasks.goal.two import TwoGoals

ROWS, STEPS = 3, 6
LADDER = {
    "noisy": 0.4,
    "laggy": 0.7,
    "limited-skill": 0.25,
    "reaction-time": 0.24,
    "noisy-gaussian": 0.5,
    "noisy-burst": 0.4,
    "delayed-noisy": 0.3,
    "reactive": 0.8,
    UNIMPAIRED: None,
}
SIMULATED = [name for name in OPERATORS if OPERATORS[name].simulated] + [UNIMPAIRED]


@pytest.fixture(scope="module")
def expert(tmp_path_factory) -> Path:
    return tiny_expert(tmp_path_factory.mktemp("expert"), TwoGoals(1, observe=()).privileged_size)


def skill(fraction: float):
    """A latent policy that is no privileged one."""
    return lambda features: (features[:, :2] * fraction).tanh()


def world() -> TwoGoals:
    return TwoGoals(ROWS, observe=("privileged",))


def informed(expert: Path) -> OperatorContext:
    return OperatorContext(
        skill, 2, world().decision_seconds, informed_policies("goal1-two", {"expert": expert})
    )


class Both:
    """An informed operator in a task, and one of the same rule who is told beforehand what to
    intend.
    """

    def __init__(self, variant: str, expert: Path) -> None:
        self.task = world()
        value = LADDER[variant]
        self.operator = build_operator(
            variant, value, informed(expert), EpisodeNoise(range(ROWS)), ROWS
        )
        self.seen = self.task.reset(range(ROWS))
        policy = load_privileged(expert, 0.25 if variant == "limited-skill" else 1.0)
        context = OperatorContext(lambda fraction: policy, 2, self.task.decision_seconds)
        self.other = build_operator(variant, value, context, EpisodeNoise(range(ROWS)), ROWS)

    def command(self) -> tuple[Tensor, Tensor]:
        features = torch.randn(ROWS, 7)
        with torch.inference_mode():
            known = privileged_view(self.operator, self.seen)
            pair = self.operator.command(features, known), self.other.command(known)
        executed = pair[0].clamp(-1, 1) * 0.5
        for operator in (self.operator, self.other):
            operator.observe(executed)
        self.seen = self.task.step(executed.numpy()).observation
        return pair


@pytest.mark.parametrize("variant", SIMULATED)
def test_in_the_task_it_follows_the_privileged_policy_with_its_own_mistakes(variant, expert):
    both = Both(variant, expert)
    for _ in range(STEPS):
        ours, theirs = both.command()
        assert torch.equal(ours, theirs)
    kept, now = both.operator.snapshot(), both.seen
    after = both.command()[0]
    both.operator.restore(kept)
    assert torch.equal(
        both.operator.command(torch.zeros(ROWS, 7), privileged_view(both.operator, now)), after
    )


@pytest.mark.parametrize("variant", SIMULATED)
def test_in_imagination_it_follows_the_latent_policy_from_its_real_memory(variant, expert):
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


def test_every_row_of_a_mixture_follows_its_own_skill(expert):
    """As SafeRL-Res is trained: every row meets the command of its own operator, whatever the
    features are.
    """
    noise = EpisodeNoise(range(ROWS))
    operators: list[Operator] = [
        build_operator("limited-skill", value, informed(expert), noise, ROWS)
        for value in (0.25, 1.0)
    ]
    mixed = MixedOperator(operators, noise, seed=0)
    mixed.choice = torch.tensor([0, 1, 0])
    known = privileged_view(mixed, world().reset(range(ROWS)))
    wanted = torch.stack([load_privileged(expert, value)(known) for value in (0.25, 1.0)])
    issued = mixed.command(torch.zeros(ROWS, 7), known)
    assert torch.equal(issued, torch.stack([wanted[0, 0], wanted[1, 1], wanted[0, 2]]))
    assert not np.allclose(wanted[0].numpy(), wanted[1].numpy())
