"""Every registered operator keeps the promises of `operators.base`."""

import pytest
import torch
from torch import Tensor

from wasp_cli.operators.base import (
    DrawnNoise,
    EpisodeNoise,
    Operator,
    OperatorContext,
    build_operator,
)
from wasp_cli.operators.mixed import MixedOperator
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED

LADDER = {
    "noisy": 0.4,
    "noisy-gaussian": 0.4,
    "noisy-burst": 0.4,
    "laggy": 0.7,
    "limited-skill": 0.25,
    "reaction-time": 0.24,
    "delayed-noisy": 0.4,
    "reactive": 0.6,
}
# those who go on otherwise after something else than their command was executed
REACTING = {"reactive"}
NAMES = [*(name for name, info in OPERATORS.items() if info.simulated), UNIMPAIRED]
ROWS, ACTION, STEPS = 4, 2, 12


def policy(features: Tensor) -> Tensor:
    return features[:, :ACTION].tanh()


def context() -> OperatorContext:
    return OperatorContext(
        skill=lambda fraction: lambda f: policy(f) * fraction,
        action_size=ACTION,
        decision_seconds=0.08,
    )


def make(name: str, seeds: list[int]) -> Operator:
    return build_operator(name, LADDER.get(name), context(), EpisodeNoise(seeds), len(seeds))


def features() -> list[Tensor]:
    source = torch.Generator().manual_seed(7)
    return [torch.randn(ROWS, 5, generator=source) for _ in range(STEPS)]


def commands(operator: Operator, seen: list[Tensor]) -> Tensor:
    return torch.stack([operator.command(f) for f in seen])


@pytest.mark.parametrize("name", NAMES)
def test_commands_are_bounded_and_repeatable(name):
    first, second = (commands(make(name, [1, 2, 3, 4]), features()) for _ in range(2))
    assert first.shape == (STEPS, ROWS, ACTION)
    assert first.abs().max() <= 1
    assert torch.equal(first, second)


@pytest.mark.parametrize("name", NAMES)
def test_memory_is_cleared_at_the_start_of_an_episode(name):
    used, seen = make(name, [1, 2, 3, 4]), features()
    commands(used, seen)
    used.reset(torch.tensor([True, False, True, False]))
    fresh = make(name, [1, 2, 3, 4])
    for key, value in used.memory.items():
        assert torch.equal(value[[0, 2]], fresh.memory[key][[0, 2]])
    same = (
        torch.equal(used.memory["queue"][1], fresh.memory["queue"][1])
        if "queue" in used.memory
        else False
    )
    assert not same


@pytest.mark.parametrize("name", NAMES)
def test_a_fork_continues_from_the_real_memory_and_leaves_it_alone(name):
    operator, seen = make(name, [1, 2, 3, 4]), features()
    commands(operator, seen[:6])
    before = dict(operator.memory)
    rows = torch.tensor([2, 0])
    uniforms = torch.rand(3, 6, operator.draws)
    fork = operator.fork(rows, 3, DrawnNoise(uniforms))
    spread = [f[rows].repeat_interleave(3, 0) for f in seen[6:9]]
    imagined = commands(fork, spread)
    assert imagined.shape == (3, 6, ACTION)
    assert all(torch.equal(before[key], operator.memory[key]) for key in before)
    memory = {key: value[rows].repeat_interleave(3, 0) for key, value in before.items()}
    for k in range(3):
        issued, memory = operator.act(operator.policy(spread[k]), memory, uniforms[k])
        assert torch.equal(imagined[k], issued)


def overridden(operator: Operator, seen: list[Tensor], by: float) -> Tensor:
    """Commands where every one of them is overridden by one that is so much larger."""
    issued = []
    for f in seen:
        issued.append(operator.command(f))
        operator.observe((issued[-1] + by).clamp(-1, 1))
    return torch.stack(issued)


@pytest.mark.parametrize("name", NAMES)
def test_only_those_who_react_go_on_otherwise_when_they_are_overridden(name):
    alone = commands(make(name, [1, 2, 3, 4]), features())
    # as one who is told nothing
    torch.testing.assert_close(overridden(make(name, [1, 2, 3, 4]), features(), 0.0), alone)
    found = overridden(make(name, [1, 2, 3, 4]), features(), 0.5)
    assert torch.equal(found[0], alone[0])
    assert torch.equal(found, alone) == (name not in REACTING)


@pytest.mark.parametrize("name", NAMES)
def test_a_row_depends_neither_on_the_others_nor_on_what_was_executed_in_them(name):
    together = overridden(make(name, [1, 2, 3, 4]), features(), 0.5)
    alone = overridden(make(name, [3]), [f[2:3] for f in features()], 0.5)
    assert torch.equal(together[:, 2:3], alone)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_observed_changes_memory_only_and_no_tensor_of_it_in_place(name):
    operator = make(name, [1, 2, 3, 4])
    overridden(operator, features()[:4], 0.5)
    before, copies = operator.memory, {key: value.clone() for key, value in operator.memory.items()}
    position = operator.noise.position()
    operator.observe(torch.ones(ROWS, ACTION))
    assert all(torch.equal(before[key], copies[key]) for key in copies)
    assert operator.memory.keys() == before.keys()
    assert torch.equal(operator.noise.position(), position)


@pytest.mark.parametrize("name", NAMES)
def test_snapshots_and_forks_bring_the_same_commands_back_and_carry_the_reaction(name):
    operator, seen = make(name, [1, 2, 3, 4]), features()
    overridden(operator, seen[:6], 0.5)
    snapshot = operator.snapshot()
    uniforms = torch.stack([EpisodeNoise([1, 2, 3, 4]).next(operator.draws) for _ in range(6)])
    fork = operator.fork(torch.tensor([2, 0]), 2, DrawnNoise(uniforms[:, [2, 2, 0, 0]]))
    imagined = overridden(fork, [f[[2, 2, 0, 0]] for f in seen[6:]], -0.5)
    wanted = overridden(operator, seen[6:], -0.5)
    operator.restore(snapshot)
    assert torch.equal(overridden(operator, seen[6:], -0.5), wanted)
    operator.restore(snapshot)
    operator.noise = DrawnNoise(uniforms)
    assert torch.equal(overridden(operator, seen[6:], -0.5)[:, [2, 2, 0, 0]], imagined)


def test_a_mixture_tells_everybody_and_its_forks_and_snapshots_too():
    noise, seen = EpisodeNoise([1, 2, 3, 4]), features()
    mixed = MixedOperator(
        [
            build_operator(name, LADDER[name], context(), noise, ROWS)
            for name in ("laggy", "reactive")
        ],
        noise,
        seed=0,
    )
    mixed.choice = torch.tensor([0, 1, 1, 0])
    found = overridden(mixed, seen[:6], 0.5)
    assert torch.equal(
        found[:, [1, 2]], overridden(make("reactive", [2, 3]), [f[1:3] for f in seen[:6]], 0.5)
    )
    snapshot = mixed.snapshot()
    uniforms = torch.rand(6, ROWS, mixed.draws)
    fork = mixed.fork(torch.tensor([1, 2]), 1, DrawnNoise(uniforms[:, 1:3]))
    imagined = overridden(fork, [f[1:3] for f in seen[6:]], 0.5)
    wanted = overridden(mixed, seen[6:], 0.5)
    mixed.choice = 1 - mixed.choice
    mixed.restore(snapshot)
    assert torch.equal(overridden(mixed, seen[6:], 0.5), wanted)
    mixed.restore(snapshot)
    mixed.noise = DrawnNoise(uniforms)
    assert torch.equal(overridden(mixed, seen[6:], 0.5)[:, 1:3], imagined)
