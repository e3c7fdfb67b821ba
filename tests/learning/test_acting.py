"""How an expert acts without exploration: by the mode of its policy, or by the mean of what it
executed.
"""

import numpy as np
import pytest
import torch

from wasp_cli.learning.acting import better_acting
from wasp_cli.learning.privileged import EpisodeSums
from wasp_cli.models.policy import (
    PrivilegedPolicy,
    checkpoint_name,
    let_act,
    load_privileged,
    mean_of_clipped,
    save_privileged,
)


def sums(returns, costs):
    returns = np.asarray(returns, float)
    costs = np.asarray(costs, float)
    return EpisodeSums(returns, costs, costs, 0 * costs, 0 * costs + 100)


@pytest.mark.parametrize("deviation", [0.05, 0.7, 3.0])
def test_the_mean_of_what_is_executed_is_that_of_draws_cut_at_the_bounds(deviation):
    centre = torch.tensor([-4.0, -1.0, -0.2, 0.0, 0.9, 2.0], dtype=torch.float64)
    spread = torch.full((6,), deviation, dtype=torch.float64)
    noise = torch.randn(400_000, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    drawn = (centre + spread * noise).clamp(-1, 1).mean(0)
    assert mean_of_clipped(centre, spread).numpy() == pytest.approx(drawn.numpy(), abs=0.006)


def test_without_exploration_both_ways_are_the_same():
    centre = torch.linspace(-2, 2, 41)
    assert mean_of_clipped(centre, torch.full((41,), 1e-4)).numpy() == pytest.approx(
        centre.clamp(-1, 1).numpy(), abs=1e-4
    )


def test_an_action_does_not_depend_on_the_rows_beside_it():
    torch.manual_seed(0)
    policy = PrivilegedPolicy(5, [16], 3, acts="mean")
    seen = torch.randn(37, 5)
    whole = policy(seen)
    assert torch.equal(
        mean_of_clipped(whole, policy.log_std.exp())[:1],
        mean_of_clipped(whole[:1], policy.log_std.exp()),
    )


def test_a_stored_policy_acts_as_it_is_told(tmp_path):
    torch.manual_seed(0)
    policy = PrivilegedPolicy(5, [16], 3)
    path = tmp_path / checkpoint_name(1.0)
    save_privileged(policy, path, 5, [16], 3)
    seen = 3 * torch.randn(9, 5)
    assert torch.equal(load_privileged(tmp_path, 1.0)(seen), policy(seen))
    let_act(path, "mean")
    policy.acts = "mean"
    assert torch.equal(load_privileged(tmp_path, 1.0)(seen), policy(seen))
    policy.acts = "mode"
    assert not torch.equal(load_privileged(tmp_path, 1.0)(seen), policy(seen))


CASES = {
    "costs less, returns as much": ([5, 6, 7, 8], [0, 1, 0, 1], "mean"),
    "returns more, costs as much": ([9, 9.5, 11, 12], [9, 8, 9, 10], "mean"),
    "returns more, costs more": ([9, 9.5, 11, 12], [19, 18, 19, 20], "mode"),
    "costs less, returns less": ([1, 1.5, 2, 4], [0, 1, 0, 1], "mode"),
    "the same": ([5, 6, 7, 8], [9, 8, 9, 10], "mode"),
    "more by chance": ([25, 1, 7, 8], [9, 8, 9, 10], "mode"),
}


@pytest.mark.parametrize(("returns", "costs", "better"), CASES.values(), ids=CASES.keys())
def test_the_mean_is_taken_where_it_is_clearly_better_and_not_worse(returns, costs, better):
    assert better_acting(sums([5, 6, 7, 8], [9, 8, 9, 10]), sums(returns, costs)) == better


def test_a_single_world_says_nothing():
    assert better_acting(sums([1], [9]), sums([9], [0])) == "mode"
