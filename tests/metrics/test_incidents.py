"""Incidents and the bound that follows from them, beside a count by hand."""

import numpy as np
import pytest

from wasp_cli.metrics.incidents import incident_cost, incident_lengths, tau_of


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
    cost, episode = np.array([1, 0, 1, 1, 1, 1]), np.array([0, 0, 0, 0, 0, 1])
    # runs of 1, 3 and 1 decisions, of which a horizon of 2 sees 1, 2 and 1
    assert incident_cost(cost, episode, 2, 0.9) == pytest.approx((1 + 1.9 + 1) / 3)
    assert incident_cost(np.zeros(3), np.zeros(3), 15, 0.95) is None


def test_a_bound_is_a_quarter_of_an_incident_and_at_most_one():
    assert tau_of(1.0) == tau_of(None) == 0.25
    assert tau_of(3.0) == 0.75
    assert tau_of(12.0) == 1.0
