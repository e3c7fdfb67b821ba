"""The safety value: its Bellman target against brute force, and what is learned of it in a world that can be searched."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.learning.recordings import recording
from wasp_cli.learning.configs.reachability import ReachabilityConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.reachability import foresight, train_safety_value
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import Skills
from wasp_cli.models.reachability import SafetyValue, danger_target
from wasp_cli.stages.base import no_progress

GAMMA = 0.9
LENGTHS = (6,) * 200


def fixed_point(arrive: Tensor, cost: Tensor, gamma: float) -> Tensor:
    """The danger [S, K] of actions in a world of S states: `arrive` [S, K] is where they lead, `cost` [S] what arriving there costs."""
    danger = torch.zeros(arrive.shape, dtype=torch.float64)
    for _ in range(2000):
        danger = danger_target(cost[arrive], danger.min(1).values[arrive], gamma)
    return danger


def test_a_failure_that_cannot_be_avoided_is_worth_less_the_further_it_is():
    """On a slope every action leads one state down, and state 0 fails: its danger k decisions away is gamma^(k - 1)."""
    states = 8
    arrive = (torch.arange(states) - 1).clamp(min=0).unsqueeze(1)
    cost = (torch.arange(states) == 0).double()
    found = fixed_point(arrive, cost, GAMMA)[:, 0]
    assert found.tolist() == pytest.approx([1.0, *(GAMMA**k for k in range(states - 1))])


def test_the_fixed_point_is_when_the_best_plan_fails_first():
    """Brute force over all plans in a random world: gamma^(k - 1) where the plan that fails last fails in its k-th decision."""
    source = torch.Generator().manual_seed(1)
    states, actions, length, gamma = 12, 2, 12, 0.5  # what lies beyond twelve decisions weighs 1 / 4096
    arrive = torch.randint(states, (states, actions), generator=source)
    cost = (torch.rand(states, generator=source) < 0.3).double()
    found = fixed_point(arrive, cost, gamma)
    plans = torch.tensor(list(product(range(actions), repeat=length)))
    different = set()
    for state, first in product(range(states), range(actions)):
        at, danger = torch.full((len(plans),), state), torch.zeros(len(plans), dtype=torch.float64)
        for k in range(length):
            at = arrive[at, plans[:, k]]
            danger = danger.where((danger > 0) | (cost[at] == 0), gamma**k)
        best = float(danger[plans[:, 0] == first].min())
        different.add(best)
        assert float(found[state, first]) == pytest.approx(best, abs=1e-3)
    assert len(different) >= 5, "a world in which everything or nothing fails shows nothing"


def test_a_value_is_the_lower_of_two_and_never_outside_of_what_margins_can_be():
    torch.manual_seed(0)
    value = SafetyValue(5, 2, 8, (1.0, 0.1))
    features, actions = torch.randn(6, 5), 2 * torch.rand(6, 4, 2) - 1
    each = 1 - 2 * value.logits(features, actions).sigmoid()
    assert torch.equal(value(features, actions), each.amin(0))
    assert value(100 * features, actions).abs().max() <= 1
    fallback, best = value.fallback(features)
    torch.testing.assert_close(value(features, fallback.unsqueeze(1))[:, 0], best)
    assert (value(features, value.extremes.unsqueeze(0)) <= best.unsqueeze(1) + 1e-6).all()


class Brakes:
    """A vehicle at x with speed v, which the first component of an action changes by up to 0.1: it fails beyond x = 1."""

    action_size, noise_size, feature_size = 2, 1, 4
    sizes = SimpleNamespace(action_scales=(1.0,))

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        v = (latent.h[:, 1] + 0.1 * action[:, 0]).clamp(-0.5, 0.5)
        return Latent(torch.stack([(latent.h[:, 0] + v).clamp(-1, 1.5), v], -1), latent.z)

    def cost(self, latent: Latent) -> Tensor:
        return (latent.h[:, 0] > 1).float()

    def continues(self, latent: Latent) -> Tensor:
        return torch.ones(len(latent.h))


def driven() -> tuple[Latents, np.ndarray, np.ndarray]:
    """Latents [N] of a vehicle under random commands that last, and the commands and costs of those rows."""
    recorded, world, source = recording(LENGTHS), Brakes(), np.random.default_rng(1)
    h, cost = np.zeros((len(recorded.first), 2), np.float32), np.zeros(len(recorded.first), np.float32)
    for row, begins in enumerate(recorded.first):
        if begins:
            h[row] = source.uniform(-0.9, 1.0), source.uniform(-0.5, 0.5)
        else:
            before = Latent(torch.from_numpy(h[row - 1 : row]), torch.zeros(1, 2))
            latent = world.imagine(before, torch.from_numpy(recorded.action[row : row + 1]), torch.zeros(1, 1))
            h[row], cost[row] = latent.h[0].numpy(), float(world.cost(latent))
    return Latents(torch.from_numpy(h), torch.zeros(len(h), 1, dtype=torch.uint8), 2), recorded.action, cost


def braked(x: float, v: float) -> float:
    """The danger of full braking from (x, v) on, the best plan: none, or gamma^(k - 1) where x = 1 is passed in the k-th decision."""
    for k in range(12):
        v = max(v - 0.1, -0.5)
        x += v
        if x > 1:
            return float(GAMMA**k)
    return 0.0


def test_training_finds_from_where_braking_comes_too_late():
    latents, action, cost = driven()
    told = recording(LENGTHS)._replace(action=action, cost=cost)
    torch.manual_seed(0)
    config = ReachabilityConfig(hidden=32, updates=500, batch=64, gamma=GAMMA, slow=0.1, learning_rate=3e-3)
    value, curve = train_safety_value(Brakes(), Skills([1.0], 4, [4], 2), told, latents, config, 1, no_progress)
    assert curve[-1]["loss"] < 0.7 * curve[0]["loss"]
    grid = [(x, v) for x in np.linspace(-0.5, 0.9, 12) for v in np.linspace(-0.2, 0.4, 8)]
    features = torch.tensor([(x, v, 1.0, 0.0) for x, v in grid], dtype=torch.float32)
    wanted = np.array([braked(x, v) for x, v in grid])
    found = (1 - value.fallback(features)[1].numpy()) / 2
    lost, saved = found[wanted > 0.8], found[wanted == 0]
    assert np.mean(lost > 0.5) > 0.8
    assert np.mean(saved < 0.5) > 0.9
    assert np.abs(found - wanted).mean() < 0.15
    # Near the edge the fallback brakes.
    edge = features[(wanted == 0) & (features[:, 1].numpy() > 0.2) & (features[:, 0].numpy() > 0.2)]
    assert (value.fallback(edge)[0][:, 0] < 0).float().mean() > 0.8


def test_the_figures_of_a_value_that_knows_and_of_one_that_does_not():
    source = np.random.default_rng(0)
    episode = np.repeat(np.arange(20), 60)
    cost = np.zeros(1200)
    cost[30::60] = 1
    near = np.array([max(0.0, 1 - abs(30 - t % 60) / 15) if t % 60 <= 30 else 0.0 for t in range(1200)])
    both = (foresight(-near, cost, episode), foresight(source.random(1200), cost, episode))
    knows, guesses = ({name: value for name, value in one.items() if value is not None} for one in both)
    assert knows["auc"] > 0.99
    assert knows["foreseen_5"] == 1.0
    assert guesses["auc"] == pytest.approx(0.5, abs=0.06)
    assert guesses["foreseen_0"] < 0.3
    assert foresight(-near, np.zeros(1200), episode)["auc"] is None
    constant = foresight(np.zeros(1200), cost, episode)
    assert constant["auc"] == pytest.approx(0.5)  # ties are neither
    assert constant["ap"] == pytest.approx(constant["costly"])
