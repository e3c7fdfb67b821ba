"""Consistency shared autonomy: one step, no draws, and a level at which nothing happens."""

import pytest
import torch
from torch import Tensor

from wasp_cli.learning.assistants import build_assistant
from wasp_cli.methods.csa import CSA
from wasp_cli.models.base import Latent
from wasp_cli.models.consistency import sigma_at
from wasp_cli.operators.base import EpisodeNoise, Operator

ROWS = 5


@pytest.fixture
def latent() -> Latent:
    source = torch.Generator().manual_seed(1)
    return Latent(torch.randn(ROWS, 12, generator=source), torch.rand(ROWS, 8, generator=source))


@pytest.fixture
def commands() -> Tensor:
    return 2 * torch.rand(ROWS, 2, generator=torch.Generator().manual_seed(2)) - 1


def executed(made: CSA, latent: Latent, commands: Tensor, seed: int = 0) -> tuple[Tensor, list[int]]:
    made.reset(torch.ones(len(commands), dtype=torch.bool), list(range(seed, seed + len(commands))))
    operator = Operator(lambda f: f[:, :2], 2, EpisodeNoise([0] * len(commands)), len(commands))
    decision = made.decide(latent, commands, operator)
    return decision.action, [] if decision.record is None else decision.record.gate.tolist()


def test_at_level_0_the_command_stands_bit_for_bit_and_nothing_intervened(parts, latent, commands):
    action, gates = executed(build_assistant("csa", {"ratio": 0.0}, parts), latent, commands)
    assert torch.equal(action, commands)
    assert gates == []


def test_the_command_itself_is_the_noisy_sample_and_one_evaluation_at_its_level_is_the_action(latent, commands):
    asked: list[tuple[Tensor, Tensor]] = []

    def network(features: Tensor, noisy: Tensor, sigma: Tensor) -> Tensor:
        asked.append((noisy, sigma))
        return 3 * noisy

    made = object.__new__(CSA)
    made.ratio, made.model = 0.4, network
    action, _ = executed(made, latent, commands)
    ((noisy, sigma),) = asked
    assert torch.equal(noisy, commands)
    assert sigma.tolist() == pytest.approx([sigma_at(0.4)] * ROWS)
    assert torch.equal(action, (3 * commands).clamp(-1, 1))
