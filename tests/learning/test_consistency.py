"""The consistency model on a flow that is known: one number with two modes, as in the figure of the method, and none of the state."""

import math

import numpy as np
import pytest
import torch

from tests.learning.recordings import recording
from wasp_cli.learning.configs.consistency import ConsistencyConfig
from wasp_cli.learning.consistency import consistency_quality, distil, follow, heun, teach, train_consistency
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator
from wasp_cli.models.consistency import SIGMA_MAX, SIGMA_MIN, Consistency, ladder, sigma_at
from wasp_cli.stages.base import no_progress

MODE, SPREAD = 0.6, 0.03
CONFIG = ConsistencyConfig(levels=20, width=48, batch=256, teacher_updates=700, updates=500, learning_rate=2e-3, ema=0.99)


def either(rows: int, source: torch.Generator) -> torch.Tensor:
    """One mode or the other, with as many on each side."""
    return MODE * (2.0 * torch.randint(2, (rows, 1), generator=source) - 1) + SPREAD * torch.randn(rows, 1, generator=source)


@pytest.fixture(scope="module")
def trained() -> tuple[Consistency, Consistency, float]:
    source = generator(0)
    torch.manual_seed(0)
    untrained = Consistency(1, 1, CONFIG.width, CONFIG.depth)

    def draw() -> tuple[torch.Tensor, torch.Tensor]:
        return torch.zeros(CONFIG.batch, 1), either(CONFIG.batch, source)

    teacher, _ = teach(untrained, draw, CONFIG, source, no_progress)
    student, loss = distil(teacher, draw, CONFIG, source, no_progress)
    return teacher, student, loss


def noisy(ratio: float, rows: int = 1000) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features, actions with the noise of a ratio, and its level."""
    source = generator(3)
    x = either(rows, source) + sigma_at(ratio) * torch.randn(rows, 1, generator=source)
    return torch.zeros(rows, 1), x, torch.full((rows,), sigma_at(ratio))


def test_the_ladder_is_that_of_karras_et_al():
    assert ladder(30)[[0, -1]].tolist() == pytest.approx([80.0, 0.002])
    assert ladder(30)[9].item() == pytest.approx(11.5, abs=0.01)  # the authors' level for the Lunar Lander
    assert ladder(30)[28].item() == pytest.approx(0.0045, abs=0.0001)  # and for PointGoal1
    assert sigma_at(20 / 29) == pytest.approx(ladder(30)[9].item())
    assert sigma_at(0) == SIGMA_MIN  # and not what rounding makes of its root


def test_at_the_lowest_level_every_action_stands_bit_for_bit():
    torch.manual_seed(0)
    model = Consistency(3, 2, 16, 2)
    features, x = torch.randn(50, 3), torch.randn(50, 2)
    assert torch.equal(model(features, x, torch.full((50,), SIGMA_MIN)), x)
    assert not torch.equal(model(features, x, torch.full((50,), sigma_at(0.1))), x)


class Gauss(Consistency):
    """The mean of a normal action, standard deviation `spread`, given a noisy one: its flow is known."""

    def __init__(self, mean: float, spread: float) -> None:
        super().__init__(1, 1, 1, 1)
        self.mean, self.spread = mean, spread

    def within(self, context: torch.Tensor, noisy: torch.Tensor, sigma: torch.Tensor) -> torch.Tensor:
        share = self.spread**2 / (self.spread**2 + sigma.unsqueeze(-1) ** 2)
        return self.mean + share * (noisy - self.mean)


def test_the_flow_of_a_normal_action_ends_where_it_should():
    """The deviation from the mean shrinks with the standard deviation: by s / sqrt(s^2 + sigma^2)."""
    teacher, x = Gauss(0.3, 0.2), torch.tensor([[-1.0], [0.3], [2.0]])
    for ratio in (0.25, 0.4, 0.69):
        shrunk = math.sqrt((0.2**2 + SIGMA_MIN**2) / (0.2**2 + sigma_at(ratio) ** 2))
        torch.testing.assert_close(follow(teacher, torch.zeros(3, 1), x, ratio, 60), 0.3 + shrunk * (x - 0.3), atol=2e-3, rtol=0)
    sigma, below = torch.full((3,), 1.0), torch.full((3,), 0.8)
    shrunk = math.sqrt((0.2**2 + 0.8**2) / (0.2**2 + 1))
    torch.testing.assert_close(heun(teacher, torch.zeros(3, 1), x, sigma, below), 0.3 + shrunk * (x - 0.3), atol=2e-3, rtol=0)


def test_one_step_of_the_student_lands_on_the_modes_where_one_of_the_teacher_falls_between(trained):
    teacher, student, _ = trained
    features, x, sigma = noisy(1.0)
    found = student(features, x, sigma)
    near = ((found.abs() - MODE).abs() < 0.15).float().mean().item()
    between = ((teacher(features, x, sigma).abs() - MODE).abs() < 0.15).float().mean().item()
    assert near > 0.8 > 0.3 > between
    assert 0.4 < (found > 0).float().mean().item() < 0.6
    assert sigma[0] == pytest.approx(SIGMA_MAX)


def test_commands_are_brought_to_the_expert_s_actions_and_the_more_so_the_higher_the_level():
    recorded = recording((40,) * 30)
    rows = len(recorded.first)
    latents = Latents(torch.randn(rows, 4, generator=generator(4)), torch.zeros(rows, 1, dtype=torch.uint8), 2)
    expert = latents.h[:, :2].tanh()  # what the expert does is in the latent
    torch.manual_seed(0)
    config = ConsistencyConfig(levels=20, width=48, batch=128, teacher_updates=500, updates=200, learning_rate=3e-3, ema=0.99)
    shares: list[float] = []
    student, _, summary = train_consistency(recorded, expert, latents, config, 1, lambda share, text: shares.append(share))
    held = torch.from_numpy(np.flatnonzero(recorded.held_out(0.1)))
    uniform = 2 * torch.rand(len(held), 2, generator=generator(2)) - 1
    found = consistency_quality(student, latents.at(held).features, expert[held], {"expert": expert[held], "uniform": uniform})
    by_ratio = list(found["uniform"].values())
    assert list(found["uniform"]) == ["0", "0.1", "0.25", "0.4", "0.69"]
    assert by_ratio[0]["fidelity"] == found["expert"]["0"]["conformity"] == 0.0
    assert [row["conformity"] for row in by_ratio] == sorted((row["conformity"] for row in by_ratio), reverse=True)
    assert [row["fidelity"] for row in by_ratio] == sorted(row["fidelity"] for row in by_ratio)
    assert by_ratio[-1]["conformity"] < 0.3 * by_ratio[0]["conformity"]
    assert summary["demonstrations"] == sum(recorded.episode % 10 != 9)  # as Diffusion's: no held-out episode
    assert shares == sorted(shares)
    assert shares[-1] < 1
