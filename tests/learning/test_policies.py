"""Labelling of latents, on-policy rounds and the rule that keeps one of them."""

import copy

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.learning.test_loops import Staggered
from wasp_cli.learning import policies
from wasp_cli.learning.behaviours import Behaviour
from wasp_cli.learning.configs import PoliciesConfig, ReinforceConfig
from wasp_cli.learning.latent_ppo import FilteredTask
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.policies import Labelled, explained, fit, new_skills
from wasp_cli.learning.reinforce import reinforce
from wasp_cli.learning.verdicts import Drive, Verdict, best_round, compare, cost_limit
from wasp_cli.methods.base import Parts
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import PrivilegedPolicy
from wasp_cli.stages.base import no_progress

CONFIG = PoliciesConfig(hidden=(16,), batch=64, learning_rate=1e-2)


class Counter:
    """h = [position, imagined steps]: an action moves the position by its first component; z
    names the position's parity.
    """

    noise_size = 2

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        h = latent.h + torch.cat([action[:, :1], torch.ones_like(action[:, :1])], 1)
        return Latent(h, torch.nn.functional.one_hot(h[:, 0].long() % 2, 2).float())


def walk(lengths: tuple[int, ...]) -> tuple[Latents, Tensor, Tensor]:
    """Filtered latents, actions by arrival and starts of episodes that begin at 100 times their
    number.
    """
    source = torch.Generator().manual_seed(0)
    position, action, first = [], [], []
    for number, length in enumerate(lengths):
        steps = torch.randint(0, 4, (length,), generator=source).float()
        steps[0] = 0
        position.append(100 * number + steps.cumsum(0))
        action.append(steps)
        first.append((torch.arange(length) == 0).float())
    x = torch.cat(position)
    latents = Latents(
        torch.stack([x, torch.zeros_like(x)], 1), (x.long() % 2).to(torch.uint8).unsqueeze(1), 2
    )
    return latents, torch.stack([torch.cat(action), torch.zeros_like(x)], 1), torch.cat(first)


def test_imagined_arrivals_end_where_the_labels_are():
    latents, action, first = walk((40, 1, 2, 57))
    found = policies.imagine_arrivals(Counter(), latents, action, first, depth=5, seed=3)
    # Under the recorded actions a perfect model arrives at the recorded state, whatever the depth
    # and never from another episode.
    assert torch.equal(found.h[:, 0], latents.h[:, 0])
    assert torch.equal(found.z, latents.z)
    steps = found.h[:, 1]
    assert (steps[first > 0] == 0).all()
    assert steps[41 + 1] == 1  # the second row of an episode has one step behind it
    assert set(steps[5:40].tolist()) == {1, 2, 3, 4, 5}
    assert torch.equal(
        policies.imagine_arrivals(Counter(), latents, action, first, 5, 3).h, found.h
    )
    assert (
        policies.imagine_arrivals(Counter(), latents, action, first, 1, 3).h[:, 1] == 1 - first
    ).all()


def states(rows: int, seed: int, shift: float) -> Labelled:
    """Labels are twice the latent for the one checkpoint and its negative for the other;
    imagined latents are shifted.
    """
    h = torch.rand(rows, 1, generator=torch.Generator().manual_seed(seed)) - 0.5
    z = torch.zeros(rows, 1, dtype=torch.uint8)
    return Labelled(Latents(h, z, 2), Latents(h + shift, z, 2), torch.stack([2 * h, -h]))


def test_skills_learn_each_its_own_checkpoint_where_they_are_asked_to():
    torch.manual_seed(0)
    experts = [PrivilegedPolicy(3, [4], 1), PrivilegedPolicy(3, [4], 1)]
    skills = new_skills(experts, [0.5, 1.0], 3, CONFIG)
    near = states(300, 1, 0.0)
    fit(skills, near, [], 150, CONFIG, 5, no_progress)
    assert min(shares["filtered"] for shares in explained(skills, near).values()) > 0.98
    assert not any(p.requires_grad for p in skills.parameters())
    # What the rounds met decides where they were and the dataset was not.
    h = torch.rand(200, 1) + 3.0
    far = Labelled(
        Latents(h, near.filtered.z[:200], 2),
        Latents(h, near.filtered.z[:200], 2),
        torch.stack([7.0 - 2 * h, 2 * h - 7.0]),
    )
    assert max(shares["filtered"] for shares in explained(skills, far).values()) < 0
    fit(skills, near, [far], 400, CONFIG, 5, no_progress)
    assert min(shares["filtered"] for shares in explained(skills, far).values()) > 0.9
    assert min(shares["filtered"] for shares in explained(skills, near).values()) > 0.9


def test_visited_rows_are_what_the_filter_showed_at_each_decision(parts):
    seeds = [0, 1, 3]
    rows = [Behaviour("expert")] * 2 + [Behaviour("early", skill=0)]
    met, latents = policies.visit(
        Staggered(3), parts.world_model, parts.skills, rows, seeds, 0, no_progress
    )
    assert met.privileged[:, 0].tolist() == [0] * 2 + [1] * 3 + [3] * 5
    # no state after an episode's end
    assert met.privileged[:, 1].tolist() == [*range(2), *range(3), *range(5)]
    assert met.episode.tolist() == [0] * 2 + [1] * 3 + [2] * 5
    assert np.flatnonzero(met.first).tolist() == [0, 2, 5]
    task, model = Staggered(1), parts.world_model
    for begin, end, seed, fraction in ((0, 2, 0, 1.0), (2, 5, 1, 1.0), (5, 10, 3, 0.25)):
        seen, latent = task.reset([seed]), model.initial(1)
        for t, row in enumerate(range(begin, end)):
            action = torch.from_numpy(met.action[row : row + 1])
            with torch.inference_mode():
                latent = model.filter(
                    latent, action, torch.from_numpy(seen.pixels), torch.tensor([float(t == 0)])
                )
                torch.testing.assert_close(latents.at(torch.tensor([row])).h, latent.h)
                torch.testing.assert_close(latents.at(torch.tensor([row])).z, latent.z)
                driven = parts.skills.at(fraction)(latent.features)
            if row + 1 < end:
                np.testing.assert_allclose(met.action[row + 1], driven[0], atol=1e-6)
            if not task.over[0]:
                seen = task.step(driven.numpy()).observation
    loop = policies.latent_episodes(Staggered(2), model, parts.skills, 0.25, [1, 3])
    assert loop.alive.sum(0).tolist() == [3, 5]
    assert loop.terminated.T.tolist() == [[False, False, True, False, False], [False] * 4 + [True]]
    # the episode of seed 3, driven by the same skill
    np.testing.assert_allclose(loop.action[:4, 1], met.action[6:10], atol=1e-6)


def test_a_verdict_by_hand():
    privileged = Drive(20.0, 10.0, 9.0, 1.0)
    good = compare(Drive(17.0, 13.0, 8.0, 1.0), privileged, CONFIG, 1000)
    assert good == Verdict(pytest.approx(0.85), pytest.approx(1.3), 0.0, 0.0, True)
    assert not compare(Drive(16.9, 0.0, 8.0, 1.0), privileged, CONFIG, 1000).reached
    dear = compare(Drive(20.0, 15.5, 8.0, 1.0), privileged, CONFIG, 1000)
    assert (dear.excess_cost, dear.reached) == (pytest.approx(2.5), False)
    # Nearly no privileged cost: kappa / 10 per 1000 env steps above it is allowed, half of that in
    # half as long an episode.
    free = Drive(20.0, 0.0, 9.0, 1.0)
    assert compare(Drive(20.0, 2.5, 9.0, 1.0), free, CONFIG, 1000) == Verdict(
        1.0, None, 0.0, 0.0, True
    )
    assert compare(Drive(20.0, 2.5, 9.0, 1.0), free, CONFIG, 500).excess_cost == pytest.approx(1.25)
    # A negative return is no base for a share: losing 15 % of its size is what is allowed.
    assert compare(
        Drive(-11.5, 0.0, 0.0, 0.0), Drive(-10.0, 0.0, 0.0, 0.0), CONFIG, 1000
    ).return_share == pytest.approx(0.85)


def test_the_kept_round_reached_both_or_cost_least_then_earned_most():
    wanted = Drive(20.0, 10.0, 9.0, 1.0)  # 17 of return are enough, 13 of cost allowed

    def best(*drives: tuple[float, float]) -> int:
        return best_round(
            [compare(Drive(*drive, 0.0, 0.0), wanted, CONFIG, 1000) for drive in drives]
        )

    assert best((19.0, 16.0), (17.1, 13.0), (24.0, 0.0)) == 1
    assert best((20.0, 14.0), (4.0, 0.0)) == 0, (
        "a policy that hardly moves costs little, and is no expert"
    )
    assert best((16.0, 30.0), (15.0, 13.0)) == 1
    assert best((10.0, 13.0), (12.0, 13.0), (11.0, 13.0)) == 1
    assert best((1.0, 90.0)) == 0
    # Two thirds of the wanted return are as far away as a third more than the allowed cost.
    assert compare(
        Drive(17.0 * 2 / 3, 0.0, 0.0, 0.0), wanted, CONFIG, 1000
    ).shortfall == pytest.approx(1 / 3)
    assert compare(
        Drive(20.0, 13.0 * 4 / 3, 0.0, 0.0), wanted, CONFIG, 1000
    ).shortfall == pytest.approx(1 / 3)


def test_the_cost_limit_by_hand():
    config = PoliciesConfig(cost_allowance=2.0)
    taught = [
        Drive(20.0, 3.0, 9.0, 1.0, env_steps=150.0),
        Drive(20.0, 5.0, 9.0, 1.0, env_steps=250.0),
    ]
    # 4 per episode, and half of 2 per 1000 of the 500 env steps that an episode may have: 4.5 in
    # 200 env steps.
    assert cost_limit(taught, 100.0, config, 500) == pytest.approx(22.5)
    assert cost_limit(taught, 400.0, config, 500) == pytest.approx(11.25), (
        "who takes twice as long must cost half as much per step"
    )
    free = PoliciesConfig(cost_allowance=0.0)
    assert cost_limit([Drive(20.0, 0.0, 9.0, 1.0, env_steps=500.0)], 500.0, free, 500) == 1.0, (
        "the excess is counted in its units"
    )


def test_the_share_of_the_return_comes_with_its_standard_error():
    """Against the spread of the share over many sets of episodes; a layout that is hard for
    both moves neither share nor error much.
    """
    random = np.random.default_rng(0)
    hard = random.normal(20, 6, (2000, 16))
    theirs, mine = (
        hard + random.normal(0, 1, hard.shape),
        0.8 * hard + random.normal(0, 2, hard.shape),
    )
    none = np.zeros(16)
    drives = [
        [Drive.of(rows, none, none, 1, none) for rows in pair]
        for pair in zip(mine, theirs, strict=True)
    ]
    found = [compare(*pair, PoliciesConfig(), 1000) for pair in drives]
    errors = np.array([verdict.return_share_se for verdict in found], float)
    assert np.mean(errors) == pytest.approx(
        np.std([verdict.return_share for verdict in found]), rel=0.1
    )
    assert np.mean(errors) < 0.5 * 6 * 2**0.5 / 4 / 20, "the episodes are paired"
    one = Drive.of(none[:1] + 3.0, none[:1], none[:1], 1, none[:1])
    assert compare(one, one, PoliciesConfig(), 1000).return_share_se is None
    assert "returns" not in one.shown()


# Reinforcement of a distilled actor, and the task behind the filter.


REINFORCED = ReinforceConfig(
    interactions=1800,
    envs=4,
    rollout=64,
    batch=64,
    learning_rate=4e-3,
    value_warmup=0.05,
    gamma=0.5,
)


def reward_of(parts: Parts, actor: torch.nn.Module) -> float:
    """Mean reward per step of the deterministic actor: the staggered task pays the first
    component of the action.
    """
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
    better, curve = reinforce(
        actor, Staggered(4), parts.world_model, REINFORCED, 1e9, "t", 0, no_progress
    )
    assert all(torch.equal(value, before[name]) for name, value in actor.state_dict().items())
    assert reward_of(parts, better) > reward_of(parts, actor) + 0.3
    assert not any(parameter.requires_grad for parameter in better.parameters())
    assert curve[-1]["interactions"] >= 1800


def test_the_multiplier_rises_while_the_cost_is_above_its_limit(parts):
    short = REINFORCED.model_copy(update={"interactions": 512, "value_warmup": 0.0})
    task, actor = Staggered(4), parts.skills.expert
    run = [
        reinforce(actor, task, parts.world_model, short, limit, "t", 0, no_progress)[1]
        for limit in (1.0, 1e9)
    ]
    assert run[0][-1]["multiplier"] > short.multiplier_init > run[1][-1]["multiplier"]
