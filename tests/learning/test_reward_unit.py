"""The unit of rewards: what a task pays per decision changes nothing that is learned from it."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from tests.learning.recordings import TINY, recording
from wasp_cli.learning.configs.recorded import ExpertConfig
from wasp_cli.learning.expert import train_expert
from wasp_cli.learning.lagrangian import MultiplierRule
from wasp_cli.learning.reward_unit import GrowingUnit, first_unit, most_excess, unit_of
from wasp_cli.learning.sampling import generator, gumbel
from wasp_cli.learning.windows import Windows
from wasp_cli.learning.world_model import build
from wasp_cli.methods.wasp.imagine import Scored
from wasp_cli.methods.wasp.search import scores
from wasp_cli.models.policy import load_privileged
from wasp_cli.tasks.make import make_task

TIMES = 128.0  # a power of two: what is divided by it loses no bit


class Slope(gymnasium.Env):
    """A ball on a slope that pays for standing high, `pays` at the top."""

    metadata = {"render_modes": [], "render_fps": 10}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Dict(
        {"state": gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)}
    )

    def __init__(self, pays: float) -> None:
        self.pays = pays

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1.0, 1.0)
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        self.place = float(np.clip(self.place + 0.1 * action[0] - 0.02, -1.0, 1.0))
        cost = float(self.place > 0.9)
        return self._seen(), self.pays * self.place, False, False, {"cost": cost}

    def _seen(self) -> Any:
        return {"state": np.array([self.place], np.float32)}


for name, pays in (("One", 1.0), ("Many", TIMES)):
    gymnasium.register(
        f"Slope{name}-v0", entry_point=Slope, max_episode_steps=80, kwargs={"pays": pays}
    )
ONE, MANY = f"{__name__}:SlopeOne-v0", f"{__name__}:SlopeMany-v0"

SMALL = ExpertConfig(
    interactions=800,
    envs=4,
    rollout=50,
    epochs=2,
    batch=50,
    hidden=(8,),
    evaluation_episodes=2,
    checkpoints=(0.25, 1.0),
)


def test_the_unit_is_twice_the_standard_deviation_of_a_decision_s_reward():
    rewards = np.array([0.0, 0.0, 3.0, -1.0])
    assert unit_of(ONE, rewards) == 2.0 * rewards.std()


def test_the_tasks_of_the_package_have_the_unit_in_which_their_settings_were_chosen():
    rewards = np.array([0.0, 100.0])
    assert unit_of("race1", rewards) == 1.0


def test_rewards_that_are_all_the_same_are_not_divided_by_zero():
    assert unit_of(ONE, np.full(7, -3.0)) == 1.0
    assert unit_of(ONE, np.zeros(0)) == 1.0


def test_a_growing_unit_never_shrinks():
    unit = GrowingUnit(ONE, 1.0)
    for rewards, wanted in (([-4.0, 4.0], 8.0), ([-0.1, 0.1], 8.0), ([-5.0, 5.0], 10.0)):
        unit.see(np.array(rewards))
        unit.settle()
        assert unit.value == wanted


def test_the_first_unit_grows_with_what_the_task_pays():
    once = first_unit(make_task(ONE, 4), "slope", 0)
    often = first_unit(make_task(MANY, 4), "slope", 0)
    assert once > 0.0
    assert often == TIMES * once


def test_a_multiplier_rises_no_faster_than_it_sinks_on_a_task_of_one_s_own():
    def rule(task: str) -> MultiplierRule:
        return MultiplierRule(1.0, 0.5, 9.0, limit=2.0, most_excess=most_excess(task))

    assert rule(ONE).next(1.0, cost=200.0) - 1.0 == 1.0 - rule(ONE).next(1.0, cost=0.0) == 0.5
    assert rule(ONE).next(1.0, cost=3.0) == rule("race1").next(1.0, cost=3.0) == 1.25
    assert rule("race1").next(1.0, cost=20.0) == 5.5


def trained(task: str, folder: Path) -> Any:
    folder.mkdir()
    batch = make_task(task, SMALL.envs, observe=("privileged",))
    # one name, so that both draw the same seeds
    train_expert(batch, SMALL, folder, "slope", 0, lambda share, text: None)
    return load_privileged(folder, 1.0).state_dict()


def test_an_expert_learns_the_same_whatever_a_reward_is_worth(tmp_path):
    once, often = trained(ONE, tmp_path / "one"), trained(MANY, tmp_path / "many")
    for name, weights in once.items():
        assert torch.equal(weights, often[name]), name


def test_a_world_model_learns_the_same_whatever_a_reward_is_worth():
    data = recording()
    rows = np.arange(len(data.first))
    gradients = []
    for times in (1.0, TIMES):
        torch.manual_seed(0)
        model = build(TINY, 2, reward_unit=times)
        paid = data._replace(reward=data.reward * np.float32(times))
        source = generator(0)
        window = Windows(paid, rows, TINY.length, 0.0, torch.device("cpu"), None).sample(2, source)
        noise = gumbel((2, TINY.length, TINY.variables, TINY.classes), source)
        terms, latent = model.losses(window.batch, noise, torch.arange(TINY.length), 1.0)
        torch.stack(list(terms.values())).sum().backward()
        gradients.append([weights.grad for weights in model.parameters()])
        assert model.reward(latent).isfinite().all()
    for one, other in zip(*gradients, strict=True):
        assert one is None or torch.equal(one, other)


def test_a_predicted_reward_is_what_the_task_pays():
    torch.manual_seed(0)
    model = build(TINY, 2, reward_unit=1.0)
    rich = build(TINY, 2, reward_unit=TIMES)
    rich.load_state_dict(model.state_dict())
    torch.nn.init.normal_(model.reward_head[-1].weight)
    rich.reward_head[-1].weight.data.copy_(model.reward_head[-1].weight.data)
    latent = model.initial(3)
    assert torch.equal(rich.reward(latent), TIMES * model.reward(latent))


def test_the_price_of_a_correction_is_in_the_unit_of_rewards_and_not_of_costs():
    residuals = torch.randn(2, 5, 3, 2, generator=torch.Generator().manual_seed(0))
    reward = torch.linspace(-1.0, 1.0, 10).view(2, 5)
    cost = torch.linspace(0.0, 3.0, 10).view(2, 5)
    task, safe, feasible = scores(Scored(residuals, reward, cost), 0.02, 1.0)
    rich = scores(Scored(residuals, TIMES * reward, cost), 0.02, 1.0, TIMES)
    assert torch.equal(rich[0], task)
    assert torch.equal(rich[1], safe)
    assert torch.equal(rich[2], feasible)
