"""Reinforcement of a distilled actor, and the task behind the filter."""

import copy

import torch

from tests.learning.test_loops import Staggered
from wasp_cli.learning.configs import ReinforceConfig
from wasp_cli.learning.latent_ppo import FilteredTask
from wasp_cli.learning.reinforce import reinforce
from wasp_cli.methods.base import Parts
from wasp_cli.stages.base import no_progress

CONFIG = ReinforceConfig(interactions=3000, envs=4, rollout=64, batch=64, learning_rate=2e-3, value_warmup=0.05, gamma=0.5)


def reward_of(parts: Parts, actor: torch.nn.Module) -> float:
    """Mean reward per step of the deterministic actor: the staggered task pays the first component of the action."""
    env = FilteredTask(Staggered(8), parts.world_model, iter(range(100_000)).__next__)
    seen, total = env.reset(), 0.0
    for _ in range(20):
        with torch.inference_mode():
            env.step_async(actor(torch.from_numpy(seen)).numpy())
        seen, reward, _, _ = env.step_wait()
        total += float(reward.mean()) / 20
    return total


def test_an_actor_earns_more_and_the_one_it_began_with_stays(parts):
    actor = copy.deepcopy(parts.skills.expert)
    with torch.no_grad():
        actor.net[-1].weight.mul_(0.1)
    before = copy.deepcopy(actor.state_dict())
    better, curve = reinforce(actor, Staggered(4), parts.world_model, CONFIG, 1e9, "t", 0, no_progress)
    assert all(torch.equal(value, before[name]) for name, value in actor.state_dict().items())
    assert reward_of(parts, better) > reward_of(parts, actor) + 0.3
    assert not any(parameter.requires_grad for parameter in better.parameters())
    assert curve[-1]["interactions"] >= 3000


def test_the_multiplier_rises_while_the_cost_is_above_its_limit(parts):
    short = CONFIG.model_copy(update={"interactions": 512, "value_warmup": 0.0})
    task, actor = Staggered(4), parts.skills.expert
    run = [reinforce(actor, task, parts.world_model, short, limit, "t", 0, no_progress)[1] for limit in (1.0, 1e9)]
    assert run[0][-1]["multiplier"] > short.multiplier_init > run[1][-1]["multiplier"]
