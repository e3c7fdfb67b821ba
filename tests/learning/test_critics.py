"""Critics in worlds whose values are known, and their comparison with real returns by hand."""

from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import torch
from scipy.stats import spearmanr
from torch import Tensor

from tests.learning.recordings import recording
from wasp_cli.learning.configs import CriticsConfig, ReturnsConfig
from wasp_cli.learning.critic_quality import (
    Pairs,
    heldout_pairs,
    pairs,
    quality,
    returns_ahead,
    write_pairs,
)
from wasp_cli.learning.critics import train_critics
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.recorded_values import recorded_values
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.methods.base import Heldout
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.policy import Skills
from wasp_cli.stages.base import no_progress

KEEP = 0.9


class Plain:
    """Every state is like the next: reward 1, cost 0.5, and the episode goes on with
    probability KEEP. h counts steps.
    """

    action_size, noise_size, feature_size = 1, 2, 3

    def __init__(self, keep: float = KEEP) -> None:
        self.keep = keep

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        return Latent(latent.h + 1, latent.z)

    def reward(self, latent: Latent) -> Tensor:
        return torch.ones(latent.h.shape[:-1])

    def cost(self, latent: Latent) -> Tensor:
        return torch.full(latent.h.shape[:-1], 0.5)

    def continues(self, latent: Latent) -> Tensor:
        return torch.full(latent.h.shape[:-1], self.keep)


def still(rows: int) -> Latents:
    return Latents(torch.zeros(rows, 1), torch.zeros(rows, 1, dtype=torch.uint8), 2)


SMALL = CriticsConfig(
    hidden=(8,),
    updates=300,
    starts=4,
    horizon=15,
    learning_rate=1e-2,
    slow=0.2,
    q_updates=400,
    q_batch=16,
    q_learning_rate=1e-2,
    q_slow=0.2,
)
torch.manual_seed(0)  # its weights are drawn: what was collected before would decide them
SKILLS = Skills([1.0], 3, [8], 1)
RETURNS = ReturnsConfig(gamma_r=0.9, gamma_c=0.5)


def steady(reward: float, cost: float, lengths: tuple[int, ...] = (12, 9, 15)) -> Recording:
    """The expert in a world of one state, in which every decision scores the same."""
    data = recording(lengths)
    with torch.no_grad():
        action = SKILLS.expert(torch.tensor([[0.0, 1.0, 0.0]])).numpy()
    return data._replace(
        action=action.repeat(len(data.first), 0),
        reward=np.float32(reward) * (1 - data.first),
        cost=np.float32(cost) * (1 - data.first),
    )


def trained(
    world: Any, data: Recording, config: CriticsConfig, latents: Latents | None = None
) -> tuple[LatentCritics, list[dict[str, float]]]:
    torch.manual_seed(0)
    where = still(len(data.first)) if latents is None else latents
    return train_critics(world, SKILLS, data, where, config, RETURNS, 0, no_progress)


@pytest.mark.parametrize("keep", [KEEP, 1.0])
def test_values_of_a_plain_world_are_geometric_sums_with_the_continuation(keep):
    critics, curve = trained(Plain(keep), recording(), SMALL.model_copy(update={"recorded": 0.0}))
    start = still(1).at(torch.zeros(1, dtype=torch.long))
    assert critics.value_r(start).item() == pytest.approx(1 / (1 - 0.9 * keep), rel=0.03)
    assert critics.value_c(start).item() == pytest.approx(0.5 / (1 - 0.5 * keep), rel=0.03)
    assert [row["update"] for row in curve] == [*range(20, 301, 20)]
    assert (
        curve[0]["target_r"]
        < curve[-1]["target_r"]
        == pytest.approx(1 / (1 - 0.9 * keep), rel=0.03)
    )


def test_q_of_recorded_transitions_is_the_discounted_sum_that_follows():
    """Endless where a time limit cuts, one decision before an episode's own end its last score,
    unknown behind it and where held out.
    """
    data = steady(2.0, 0.5, (6, 6, 6))
    data.terminal[11] = 1
    latents, skills = (
        Latents(torch.eye(18), torch.zeros(18, 1, dtype=torch.uint8), 2),
        Skills([1.0], 20, [8], 1),
    )
    with torch.no_grad():
        # so that nothing has to be guessed
        data.action[1:] = skills.expert(latents.at(torch.arange(17)).features)
    torch.manual_seed(0)
    config = SMALL.model_copy(update={"q_updates": 1000, "hidden": (32,)})
    values, curve = recorded_values(skills, data, latents, config, RETURNS, 0, no_progress)
    ahead = np.arange(5, 0, -1)
    np.testing.assert_allclose(values[0, 6:11], 2.0 * (1 - 0.9**ahead) / 0.1, rtol=0.1)
    np.testing.assert_allclose(values[1, 6:11], 0.5 * (1 - 0.5**ahead) / 0.5, rtol=0.1)
    assert values.isnan().all(0).tolist() == [False] * 11 + [True] * 7
    assert curve[-1]["q_loss_r"] < curve[0]["q_loss_r"]


class Blind(Plain):
    """Nothing is imagined to be worth or to cost anything."""

    def reward(self, latent: Latent) -> Tensor:
        return torch.zeros(latent.h.shape[:-1])

    cost = reward


@pytest.mark.slow
def test_what_was_recorded_mends_what_imagination_cannot_know():
    data = steady(1.0, 0.5)
    filtered, ahead = (
        still(1).at(torch.zeros(1, dtype=torch.long)),
        Latent(torch.full((1, 1), 5.0), torch.tensor([[1.0, 0.0]])),
    )
    alone, _ = trained(Blind(1.0), data, SMALL.model_copy(update={"recorded": 0.0}))
    mended, curve = trained(
        Blind(1.0), data, SMALL.model_copy(update={"recorded": 30.0, "q_updates": 700})
    )
    for latent in (filtered, ahead):
        assert alone.value_r(latent).item() == pytest.approx(0.0, abs=0.05)
        assert mended.value_r(latent).item() == pytest.approx(10.0, rel=0.1)
        assert mended.value_c(latent).item() == pytest.approx(1.0, rel=0.1)
    assert [row["update"] for row in curve if "q_loss_r" in row] == [*range(100, 701, 100)]
    assert [row["update"] for row in curve if "recorded_loss_r" in row] == [*range(20, 301, 20)]


@pytest.mark.parametrize("recorded", [0.0, 1.0])
def test_held_out_rows_move_nothing(recorded):
    config = SMALL.model_copy(update={"updates": 20, "q_updates": 20, "recorded": recorded})
    data = steady(1.0, 0.5)
    source = np.random.default_rng(1)
    h = torch.from_numpy(source.normal(size=(36, 1)).astype(np.float32))
    seen, _ = trained(Plain(), data, config, still(36)._replace(h=h))
    out = data.held_out(HELD_OUT)
    assert 0 < out.sum() < 36
    other = data._replace(
        **{name: getattr(data, name).copy() for name in ("action", "reward", "cost")}
    )
    for values in (other.reward, other.cost, other.action):
        values[out] = 7.0
    moved = h.clone()
    moved[torch.from_numpy(out)] = 50.0
    again, _ = trained(Plain(), other, config, still(36)._replace(h=moved))
    assert all(
        torch.equal(a, b)
        for a, b in zip(seen.state_dict().values(), again.state_dict().values(), strict=True)
    )


def test_returns_ahead_by_hand():
    signal = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    episode, terminal = np.array([0, 0, 0, 1, 1]), np.array([0, 0, 0, 0, 1])
    sums, beyond = returns_ahead(signal, episode, terminal, 0.5)
    assert sums.tolist() == [3.0, 4.0, 4.0, 16.0, 16.0]
    # the second episode ended by itself: nothing is missing
    assert beyond.tolist() == [0.125, 0.25, 0.5, 0.0, 0.0]


def test_only_decisions_with_a_recorded_future_count():
    random = np.random.default_rng(0)
    episode = np.repeat([0, 1], [100, 30])
    signal, predicted, terminal = random.random(130), random.random(130), np.zeros(130)
    cut = pairs(predicted, signal, episode, terminal, 0.9)  # 0.9^28 = 0.052, 0.9^29 = 0.047
    assert len(cut.real) == (100 - 28) + (30 - 28)
    assert cut.cut_off == pytest.approx(0.9**29)
    terminal[129] = 1
    assert len(pairs(predicted, signal, episode, terminal, 0.9).real) == (100 - 28) + 30
    # no episode is long enough: the first half of the longest counts
    slow = pairs(predicted, signal, episode, np.zeros(130), 0.999)
    assert len(slow.real) == 51
    assert slow.cut_off == pytest.approx(0.999**50)
    # What lies beyond the limit is filled up with the mean: a constant signal has the constant's
    # endless sum everywhere.
    np.testing.assert_allclose(
        pairs(predicted, np.ones(130), episode, np.zeros(130), 0.999).real, 1000.0
    )
    assert pairs(predicted, signal, episode, np.zeros(130), 1.0).cut_off == 1.0


def test_ranks_and_ratios_have_intervals_over_episodes():
    random = np.random.default_rng(1)
    a, b = random.integers(0, 4, 60).astype(float), random.normal(size=60) + 2
    found = quality(Pairs(a, a + b, np.repeat([0, 1, 2, 3], 15), 0.0))
    assert found["rank"] == pytest.approx(spearmanr(a, a + b).statistic)
    assert found["predicted_over_real"] == pytest.approx(a.mean() / (a + b).mean())
    for name in ("rank", "predicted_over_real"):
        low, value, high = (found[name + end] for end in ("_low", "", "_high"))
        assert low < value < high
    # One episode has all of the cost: a quarter of the resamples has more than twice as much of it
    # as there is, many have none.
    rare = quality(
        Pairs(np.ones(60), np.repeat([0.0, 0.0, 0.0, 4.0], 15), np.repeat([0, 1, 2, 3], 15), 0.0)
    )
    assert rare["predicted_over_real"] == 1.0
    assert rare["predicted_over_real_high"] == 1.0
    assert rare["predicted_over_real_low"] == pytest.approx(1 / 3)
    alone = quality(Pairs(a, a + b, np.zeros(60), 0.0))
    assert (alone["rank"], alone["rank_low"], alone["predicted_over_real_high"]) == (
        found["rank"],
        None,
        None,
    )


def test_a_perfect_critic_is_found_perfect_and_a_silent_one_undefined(tmp_path):
    random = torch.Generator().manual_seed(0)
    reward = torch.rand(200, generator=random)
    episode, terminal = torch.arange(200) // 50, (torch.arange(200) % 50 == 49).float()
    real, _ = returns_ahead(reward.double().numpy(), episode.numpy(), terminal.numpy(), 0.9)

    class Oracle:
        def value_r(self, latent: Latent) -> Tensor:
            return torch.from_numpy(real).float()

        def value_c(self, latent: Latent) -> Tensor:
            return torch.zeros(200)

    latent = Latent(torch.zeros(200, 1), torch.zeros(200, 2))
    heldout = Heldout(
        latent, torch.zeros(200, 1), reward, (reward > 0.8).float(), episode, terminal
    )
    found = heldout_pairs(Oracle(), heldout, ReturnsConfig(gamma_r=0.9, gamma_c=0.9))
    judged: dict[str, Any] = {name: quality(one) for name, one in found.items()}
    assert judged["r"]["rank"] == pytest.approx(1.0)
    assert judged["r"]["predicted_over_real"] == pytest.approx(1.0, rel=1e-4)
    assert judged["c"]["rank"] is None
    assert judged["c"]["predicted_over_real"] == 0.0
    write_pairs(tmp_path / "pairs.parquet", found)
    once = (tmp_path / "pairs.parquet").read_bytes()
    write_pairs(tmp_path / "pairs.parquet", found)
    assert (tmp_path / "pairs.parquet").read_bytes() == once
    stored = pq.read_table(tmp_path / "pairs.parquet")
    for name, one in found.items():
        mine = stored.filter(pc.field("critic") == name)
        np.testing.assert_array_equal(mine["predicted"].to_numpy(), one.predicted)
        np.testing.assert_array_equal(mine["real"].to_numpy(), one.real)
