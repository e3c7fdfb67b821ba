"""Incidents and the bound that follows from them, beside a count by hand."""

import numpy as np
import pytest

from wasp_cli.errors import ArtifactError
from wasp_cli.metrics.incidents import (
    incident_cost,
    incident_lengths,
    read_incidents,
    tau_of,
    write_incidents,
)


def by_hand(cost, episode):
    lengths, running = [], 0
    for i, (costs, number) in enumerate(zip(cost, episode, strict=True)):
        if running and (not costs or number != episode[i - 1]):
            lengths.append(running)
            running = 0
        running += bool(costs)
    return [*lengths, running] if running else lengths


def test_incidents_are_runs_within_an_episode():
    random = np.random.default_rng(0)
    for _ in range(50):
        cost = (random.random(60) < 0.4).astype(np.float32)
        episode = np.sort(random.integers(0, 5, 60))
        assert incident_lengths(cost, episode).tolist() == by_hand(cost, episode)


def test_an_incident_costs_what_a_gate_sums_of_it():
    lengths = np.array([1, 3, 1])
    # a horizon of 2 sees 1, 2 and 1 of them
    assert incident_cost(lengths, 2, 0.9) == pytest.approx((1 + 1.9 + 1) / 3)
    assert incident_cost(np.zeros(0, np.int64), 15, 0.95) is None


@pytest.mark.parametrize("lengths", [[], [1, 1, 3, 7]])
def test_a_dataset_keeps_the_lengths_of_its_incidents(tmp_path, lengths):
    write_incidents(tmp_path, np.array(lengths, np.int64))
    assert read_incidents(tmp_path).tolist() == lengths


def test_a_dataset_that_did_not_count_incidents_says_what_to_do(tmp_path):
    with pytest.raises(ArtifactError, match="how long its incidents are") as caught:
        read_incidents(tmp_path)
    assert "tau_c" in str(caught.value.hint)


def test_a_bound_is_a_quarter_of_an_incident_and_at_most_one():
    assert tau_of(1.0) == tau_of(None) == 0.25
    assert tau_of(3.0) == 0.75
    assert tau_of(12.0) == 1.0
