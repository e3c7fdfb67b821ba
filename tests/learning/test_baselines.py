"""What the baselines learn from: their own objectives, on problems whose answer is known."""

import math

import numpy as np
import pytest
import torch

from tests.learning.recordings import recording
from tests.learning.test_loops import Staggered
from wasp_cli.errors import TrainingError
from wasp_cli.learning.configs import DenoiserConfig, EnsembleConfig, ResidualConfig
from wasp_cli.learning.configs.consistency import ConsistencyConfig
from wasp_cli.learning.consistency import (
    consistency_quality,
    distil,
    follow,
    heun,
    teach,
    train_consistency,
)
from wasp_cli.learning.denoiser import denoiser_quality, noise_loss, train_denoiser
from wasp_cli.learning.ensemble import train_ensemble
from wasp_cli.learning.lagrangian import ReturnRule
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.residual import AssistedTask, train_residual
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import Recording
from wasp_cli.methods.base import Parts
from wasp_cli.models.consistency import SIGMA_MAX, SIGMA_MIN, Consistency, ladder, sigma_at
from wasp_cli.models.denoiser import Denoiser
from wasp_cli.models.policy import Skills
from wasp_cli.stages.base import no_progress


@pytest.fixture(scope="module")
def data() -> tuple[Recording, Latents]:
    recorded = recording((40,) * 30)
    recorded.cost_env[:] = 0
    source = torch.Generator().manual_seed(4)
    rows = len(recorded.first)
    return recorded, Latents(
        torch.randn(rows, 4, generator=source), torch.zeros(rows, 1, dtype=torch.uint8), 2
    )


def test_a_denoiser_brings_commands_to_the_expert_s_actions_and_a_larger_ratio_does_so_more(data):
    recorded, latents = data
    expert = latents.h[:, :2].tanh()  # what the expert does is in the latent
    torch.manual_seed(0)
    config = DenoiserConfig(updates=600, batch=192, hidden=(64, 64), ema=0.99)
    denoiser, schedule, summary = train_denoiser(recorded, expert, latents, config, 1, no_progress)
    source = torch.Generator().manual_seed(2)
    held = torch.from_numpy(np.flatnonzero(recorded.held_out(0.1)))
    features = latents.at(held).features
    # predicting no noise at all scores 1
    assert noise_loss(denoiser, schedule, features, expert[held], source) < 0.5
    found = denoiser_quality(
        denoiser, schedule, features, expert[held], torch.zeros(len(held), 2), source
    )
    by_ratio = [found["uniform"][ratio] for ratio in ("0", "0.2", "0.4", "0.6")]
    assert by_ratio[0]["fidelity"] == 0.0
    assert [row["conformity"] for row in by_ratio] == sorted(
        (row["conformity"] for row in by_ratio), reverse=True
    )
    assert [row["fidelity"] for row in by_ratio] == sorted(row["fidelity"] for row in by_ratio)
    assert by_ratio[2]["conformity"] < 0.7 * by_ratio[0]["conformity"]
    assert found["expert"]["0"]["conformity"] == 0.0
    assert summary["demonstrations"] == sum(recorded.episode % 10 != 9)
    assert {kind: len(by_ratio) for kind, by_ratio in found.items()} == {
        "expert": 5,
        "recorded": 5,
        "uniform": 5,
    }


def test_the_weights_that_are_used_are_the_average_over_the_updates(data):
    recorded, latents = data

    def weights(updates: int, ema: float) -> torch.Tensor:
        torch.manual_seed(0)
        config = DenoiserConfig(updates=updates, batch=16, hidden=(8,), ema=ema)
        denoiser, _, _ = train_denoiser(
            recorded, latents.h[:, :2].tanh(), latents, config, 1, no_progress
        )
        return torch.cat([parameter.flatten() for parameter in denoiser.parameters()])

    # of a training of the same draws that stops there
    last = [weights(updates, 0.0) for updates in (1, 2, 3)]
    torch.manual_seed(0)
    average = torch.cat(
        [parameter.flatten() for parameter in Denoiser(6, 2, [8], 50).parameters()]
    ).detach()
    for update, now in enumerate(last):
        decay = min(0.15, (1 + update) / (10 + update))  # it forgets the first updates sooner
        average = decay * average + (1 - decay) * now
    torch.testing.assert_close(weights(3, 0.15), average)
    assert not torch.allclose(weights(3, 0.15), last[-1])


def test_an_ensemble_learns_what_an_action_is_worth_under_the_expert(data):
    """The reward of an action is 1 - (a_0 - x)^2 at a latent that begins with x; the expert
    does nothing.
    """
    recorded, latents = data
    x = latents.h[:, 0].clamp(-1, 1)
    reward = np.zeros_like(recorded.reward)
    reward[1:] = 1 - (recorded.action[1:, 0] - x.numpy()[:-1]) ** 2
    told = recorded._replace(reward=reward)
    skills = Skills([1.0], 6, [4], 2)
    torch.nn.init.zeros_(skills.expert.net[-1].weight)
    torch.nn.init.zeros_(skills.expert.net[-1].bias)
    torch.manual_seed(0)
    config = EnsembleConfig(
        members=3, hidden=(64, 64), updates=1500, batch=128, learning_rate=2e-3, target_rate=0.05
    )
    gamma = 0.5
    ensemble, curve = train_ensemble(skills, told, latents, config, gamma, 1, no_progress)
    assert curve[-1] < 0.3 * curve[0]
    index = torch.arange(0, len(x), 7)
    features, at = latents.at(index).features, x[index]
    good, bad = (
        at.unsqueeze(-1).expand(-1, 2) * torch.tensor([1.0, 0.0]),
        torch.stack([-at.sign(), 0 * at], -1),
    )
    gain = (ensemble(features, good) - ensemble(features, bad)).mean(0)
    wanted = (bad[:, 0] - at) ** 2
    assert np.corrcoef(gain.detach(), wanted)[0, 1] > 0.9
    # What follows is the expert's: 1 - E x^2, every other decision half as much.
    later = gamma / (1 - gamma) * float(1 - x.square().mean())
    assert float(ensemble(features, good).mean()) == pytest.approx(1 + later, abs=0.2)


SMALL = ResidualConfig(
    interactions=4000,
    envs=4,
    rollout=64,
    batch=64,
    hidden=(16,),
    learning_rate=3e-3,
    gamma=0.5,
    log_std_init=-0.5,
    alpha=0.01,
    value_warmup=0.0,
    multiplier_delay=0.0,
    multiplier_init=0.0,
    operators={"noisy": (0.2,)},
)


def pushes(
    parts: Parts, config: ResidualConfig, expert_return: float = math.nan
) -> tuple[float, float, list[dict[str, float]]]:
    """Mean of the residual's components after training in a task that pays the first component
    of the action.
    """
    policy, curve = train_residual(
        Staggered(4),
        parts.world_model,
        parts.skills,
        config,
        "t",
        0,
        no_progress,
        expert_return=expert_return,
    )
    with torch.inference_mode():
        mean = policy(
            torch.randn(500, parts.world_model.feature_size), torch.rand(500, 2) - 0.5
        ).mean(0)
    return float(mean[0]), float(mean[1]), curve


@pytest.mark.slow
def test_the_lagrangian_residual_learns_what_pays(parts):
    first, second, curve = pushes(parts, SMALL.model_copy(update={"cost_limit": 1e6}))
    assert first > 0.3
    assert abs(second) < first / 2
    assert (
        np.nanmean([row["return"] for row in curve[-4:]])
        > np.nanmean([row["return"] for row in curve[:4]]) + 0.5
    )


@pytest.mark.slow
def test_rsa_does_no_more_than_the_least_return_asks_for(parts):
    rsa = SMALL.model_copy(
        update={"mode": "rsa", "multiplier_lr": 0.3, "multiplier_init": 2.0, "interactions": 3000}
    )
    content, _, calm = pushes(parts, rsa, expert_return=1e-3)
    asked, _, eager = pushes(parts, rsa, expert_return=10.0)
    assert eager[-1]["multiplier"] > 1.0 > calm[-1]["multiplier"]
    assert asked > 0.2
    assert abs(content) < asked / 2


@pytest.mark.parametrize("expert_return", [math.nan, 0.0, -3.0])
def test_rsa_asks_for_a_share_of_a_positive_return(parts, expert_return):
    with pytest.raises(TrainingError, match="mode rsa asks for"):
        pushes(parts, SMALL.model_copy(update={"mode": "rsa"}), expert_return)


def test_both_objectives_against_their_formulas(parts):
    commands = torch.tensor([[0.9, -0.5], [0.2, 0.1], [-1.0, 0.0]])
    action = np.array([[0.5, 0.1], [-1.6, 0.3], [-0.2, 0.0]], np.float32)
    # what is penalised is what is executed
    delta = np.clip(commands.numpy() + action, -1, 1) - commands.numpy()
    for mode in ("lagrangian", "rsa"):
        config = SMALL.model_copy(update={"mode": mode, "alpha": 0.3})
        env = AssistedTask(Staggered(3), parts.world_model, parts.skills, config, "t", 0)
        env.normalise = True
        env.reset()
        env._command, env.multiplier = commands, 0.7
        executed, penalty = env.execute(action)
        env.task.step(executed)
        step = env.task.step(executed)  # the second step of every row costs
        norm = np.linalg.norm(delta, axis=1)
        if mode == "lagrangian":
            wanted = (step.reward - 0.3 * norm**2 - 0.7 * step.cost) / 1.7
        else:
            wanted = (0.7 * step.reward - np.where(norm <= 1, norm**2 / 2, norm - 0.5)) / 1.7
        np.testing.assert_allclose(env.objective(step, penalty), wanted, rtol=1e-5)
        assert step.cost.any()


def test_the_multiplier_of_a_least_return_rises_below_it_and_falls_above():
    rule = ReturnRule(0.5, 0.2, 1.0, least=10.0)
    assert rule.next(0.5, 5.0) == pytest.approx(0.6)
    assert rule.next(0.5, 20.0) == pytest.approx(0.3)
    assert rule.next(0.1, 30.0) == 0.0
    assert rule.next(0.95, -10.0) == 1.0
    with pytest.raises(ValueError, match="positive"):
        ReturnRule(0.5, 0.2, 1.0, least=0.0)


# The consistency model on a flow that is known: one number with two modes, as in the figure of the
# method, and none of the state.


MODE, SPREAD = 0.6, 0.03
CONFIG = ConsistencyConfig(
    levels=20, width=48, batch=256, teacher_updates=700, updates=500, learning_rate=2e-3, ema=0.99
)


def either(rows: int, source: torch.Generator) -> torch.Tensor:
    """One mode or the other, with as many on each side."""
    return MODE * (2.0 * torch.randint(2, (rows, 1), generator=source) - 1) + SPREAD * torch.randn(
        rows, 1, generator=source
    )


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
    # the authors' level for the Lunar Lander
    assert ladder(30)[9].item() == pytest.approx(11.5, abs=0.01)
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
    """The mean of a normal action, standard deviation `spread`, given a noisy one: its flow is
    known.
    """

    def __init__(self, mean: float, spread: float) -> None:
        super().__init__(1, 1, 1, 1)
        self.mean, self.spread = mean, spread

    def within(
        self, context: torch.Tensor, noisy: torch.Tensor, sigma: torch.Tensor
    ) -> torch.Tensor:
        share = self.spread**2 / (self.spread**2 + sigma.unsqueeze(-1) ** 2)
        return self.mean + share * (noisy - self.mean)


def test_the_flow_of_a_normal_action_ends_where_it_should():
    """The deviation from the mean shrinks with the standard deviation: by s / sqrt(s^2 +
    sigma^2).
    """
    teacher, x = Gauss(0.3, 0.2), torch.tensor([[-1.0], [0.3], [2.0]])
    for ratio in (0.25, 0.4, 0.69):
        shrunk = math.sqrt((0.2**2 + SIGMA_MIN**2) / (0.2**2 + sigma_at(ratio) ** 2))
        torch.testing.assert_close(
            follow(teacher, torch.zeros(3, 1), x, ratio, 60),
            0.3 + shrunk * (x - 0.3),
            atol=2e-3,
            rtol=0,
        )
    sigma, below = torch.full((3,), 1.0), torch.full((3,), 0.8)
    shrunk = math.sqrt((0.2**2 + 0.8**2) / (0.2**2 + 1))
    torch.testing.assert_close(
        heun(teacher, torch.zeros(3, 1), x, sigma, below),
        0.3 + shrunk * (x - 0.3),
        atol=2e-3,
        rtol=0,
    )


@pytest.mark.slow
def test_one_step_of_the_student_lands_on_the_modes_where_one_of_the_teacher_falls_between(trained):
    teacher, student, _ = trained
    features, x, sigma = noisy(1.0)
    found = student(features, x, sigma)
    near = ((found.abs() - MODE).abs() < 0.15).float().mean().item()
    between = ((teacher(features, x, sigma).abs() - MODE).abs() < 0.15).float().mean().item()
    assert near > 0.8 > 0.3 > between
    assert 0.4 < (found > 0).float().mean().item() < 0.6
    assert sigma[0] == pytest.approx(SIGMA_MAX)


def test_commands_are_brought_to_the_expert_s_actions_and_the_more_so_the_higher_the_level(data):
    recorded, latents = data
    expert = latents.h[:, :2].tanh()  # what the expert does is in the latent
    torch.manual_seed(0)
    config = ConsistencyConfig(
        levels=20,
        width=48,
        batch=128,
        teacher_updates=500,
        updates=200,
        learning_rate=3e-3,
        ema=0.99,
    )
    shares: list[float] = []
    student, _, summary = train_consistency(
        recorded, expert, latents, config, 1, lambda share, text: shares.append(share)
    )
    held = torch.from_numpy(np.flatnonzero(recorded.held_out(0.1)))
    uniform = 2 * torch.rand(len(held), 2, generator=generator(2)) - 1
    found = consistency_quality(
        student,
        latents.at(held).features,
        expert[held],
        {"expert": expert[held], "uniform": uniform},
    )
    by_ratio = list(found["uniform"].values())
    assert list(found["uniform"]) == ["0", "0.1", "0.25", "0.4", "0.69"]
    assert by_ratio[0]["fidelity"] == found["expert"]["0"]["conformity"] == 0.0
    assert [row["conformity"] for row in by_ratio] == sorted(
        (row["conformity"] for row in by_ratio), reverse=True
    )
    assert [row["fidelity"] for row in by_ratio] == sorted(row["fidelity"] for row in by_ratio)
    assert by_ratio[-1]["conformity"] < 0.3 * by_ratio[0]["conformity"]
    # as Diffusion's: no held-out episode
    assert summary["demonstrations"] == sum(recorded.episode % 10 != 9)
    assert shares == sorted(shares)
    assert shares[-1] < 1
