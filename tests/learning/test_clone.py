"""Clones of operators: densities, what is learned of a rule that is known, and where a plan has one."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from wasp_cli.learning.clone import Issued, fit_clone
from wasp_cli.learning.configs import CloneConfig
from wasp_cli.models.clone import Clone
from wasp_cli.operators.base import EpisodeNoise, OperatorContext, build_operator
from wasp_cli.plan.grid import OPERATOR_CLONE, lay_out
from wasp_cli.spec.model import validate
from wasp_cli.stages.base import no_progress

FEATURES, ACTIONS = 3, 2


def expert(features: Tensor) -> Tensor:
    return (0.8 * features[:, :ACTIONS]).clamp(-1, 1)


def driven(variant: str, value: float, rows: int = 16, decisions: int = 120) -> Issued:
    """What an operator issues for random features: a different episode in every row."""
    source = torch.Generator().manual_seed(0)
    context = OperatorContext(lambda fraction: expert, ACTIONS, 0.08)
    operator = build_operator(variant, value, context, EpisodeNoise(list(range(rows))), rows)
    parts, last = [], torch.full((rows, ACTIONS), torch.nan)
    for _ in range(decisions):
        seen = torch.randn(rows, FEATURES, generator=source)
        command = operator.command(seen).clamp(-1, 1)
        parts.append(Issued(seen, command, last))
        last = command
    return Issued(*(torch.cat(fields) for fields in zip(*parts, strict=True)))


def learned(seen: Issued, updates: int = 400) -> Clone:
    torch.manual_seed(0)
    config = CloneConfig(hidden=(16,), updates=updates, learning_rate=1e-2)
    return fit_clone(seen, expert, config, 0, no_progress)[0]


@pytest.mark.parametrize(
    ("variant", "value", "ways"), [("laggy", 0.7, [0.7, 0.3, 0.0]), ("noisy", 0.4, [0.0, 0.6, 0.4]), ("laggy", 0.0, [0.0, 1.0, 0.0])]
)
def test_it_learns_how_often_an_operator_repeats_and_slips(variant, value, ways):
    clone = learned(driven(variant, value))
    assert clone.weight_logits.softmax(-1).tolist() == pytest.approx(ways, abs=0.05)
    assert clone.spread.max() < 0.1


def test_it_learns_what_an_operator_intends_where_that_is_not_the_expert_s():
    seen = driven("laggy", 0.0)
    own = (0.8 * seen.features[:, 1:] - 0.2).clamp(-1, 1)
    clone = learned(seen._replace(command=own), updates=900)
    error = (clone.intended(seen.features, seen.last, expert(seen.features)) - own).square().mean()
    assert error < 0.1 * (expert(seen.features) - own).square().mean()


def test_densities_integrate_to_one_within_the_bounds_and_draws_follow_them():
    torch.manual_seed(0)
    clone = Clone(FEATURES, [4], 1)
    clone.log_spread.data.fill_(np.log(0.1))
    clone.weight_logits.data[:] = torch.tensor([0.4, 0.5, 0.1]).log()
    line = torch.linspace(-1, 1, 4001).unsqueeze(1)
    one = torch.zeros(1, FEATURES), torch.tensor([[0.4]]), torch.tensor([[-0.2]])
    clone.requires_grad_(False)
    density = clone.log_density(line, *(part.expand(len(line), -1) for part in one)).exp()
    assert float(torch.trapezoid(density, line[:, 0])) == pytest.approx(1.0, abs=0.01)
    many = tuple(part.expand(20_000, -1) for part in one)
    drawn = clone.sample(*many, torch.rand(20_000, 2))
    assert float((drawn == 0.4).float().mean()) == pytest.approx(0.4, abs=0.02)
    assert float(((drawn + 0.2).abs() < 0.3).float().mean()) == pytest.approx(0.5 + 0.1 * 0.3, abs=0.02)
    assert float(clone.mean(*one)) == pytest.approx(float(drawn.mean()), abs=0.02)


DOCUMENT: dict[str, Any] = {
    "name": "x", "preset": "smoke", "tasks": ["goal1"], "methods": ["human", "wasp"], "seeds": [0],
    "operators": {"laggy": {"low": 0.5, "high": 0.7}, "noisy": {"some": 0.4}},
}  # fmt: skip


def test_where_a_person_s_clone_drives_it_is_read_and_what_fits_it_is_in_its_key():
    grid = lay_out(validate({**DOCUMENT, "methods": ["human"], "operators": {"cloned": {"p7": 7}}}))
    ((_, evaluation),) = grid.cells
    node = evaluation.needs[OPERATOR_CLONE]
    assert (node.kind, node.axes["operator"], node.axes["value"]) == ("clone", "person", 7)
    assert "wasp_cli.learning.clone" in node.modules
