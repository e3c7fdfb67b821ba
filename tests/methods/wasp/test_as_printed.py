"""`wasp.recipe: paper` against a literal reading of section 4: one decision, call by call and number by number."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.worlds import Corridor, LinearCritics
from wasp_cli.methods.base import Heldout
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.noise import DecisionNoise, as_gumbel
from wasp_cli.methods.wasp.assistant import PROBE as PROBING
from wasp_cli.methods.wasp.assistant import SEARCH, WASP
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import EpisodeNoise, Operator

GAMMA, OTHER, LAM = 0.9, 0.8, 0.7
LOW, HIGH, JITTER = 0.3, 0.6, 0.05
H, L, M, N, PROBE, ELITES, N_F, ITERATIONS, ALPHA, STD, FLOOR = 6, 3, 2, 24, 20, 6, 5, 3, 0.1, 0.5, 0.05
SIZES: dict[str, Any] = {
    "horizon": H, "residual_steps": L, "candidates": N, "probe": PROBE, "elites": ELITES, "feasible": N_F, "iterations": ITERATIONS,
    "rollouts": M, "alpha": ALPHA, "initial_std": STD, "std_floor": FLOOR,
}  # fmt: skip
SEED = 11


def pi_h(x: float) -> float:
    return min(1.0, max(-1.0, 0.9 - x))


class Found(NamedTuple):
    reward: float
    cost: float
    effort: float


def eq_7_8(signal: list[float], value: list[float]) -> float:
    """TD-lambda return at k = 0; `value` at the arrived states."""
    g = value[-1]
    for k in reversed(range(len(signal))):
        g = signal[k] + GAMMA * ((1 - LAM) * value[k] + LAM * g)
    return g


def imagined(x: float, a_h: float, residual: list[float] | None, noise: Tensor) -> Found:
    """Mean over the rollouts of `noise` [H, M, Z]; without a residual the operator alone (Eq. 9-10), else Eq. 13 as printed."""
    total = np.zeros(2)
    for m in range(noise.shape[1]):
        place, rewards, costs, places = x, [], [], []
        for k in range(H):
            command = a_h if k == 0 else pi_h(place)
            action = command if residual is None or k >= L else min(1.0, max(-1.0, a_h + residual[k]))
            place = place + 0.1 * action + JITTER * float(noise[k, m, 0])
            rewards.append(0.1 * action)
            costs.append(1.0 if LOW < place < HIGH else 0.0)
            places.append(place)
        total += [eq_7_8(rewards, [0.5 * p for p in places]), eq_7_8(costs, [0.25 * abs(p) for p in places])]
    reward, cost = total / noise.shape[1]
    return Found(reward, cost, 0.0 if residual is None else sum(r * r for r in residual))


class Outcome(NamedTuple):
    gate: int
    action: float
    g_cost: float
    g_return: float
    delta_g: float | None
    safe: list[int]
    batches: list[int]
    """Candidates of every call to the world model, in order."""


def section_4(x: float, a_h: float, tau_c: float, tau_r: float) -> Outcome:
    """One decision, from the same draws as the assistant's."""
    source = DecisionNoise()
    source.reset(torch.ones(1, dtype=torch.bool), [SEED])
    own = source.streams()
    noise = as_gumbel(own.uniform((H, M, 2))[0])[0]
    alone = imagined(x, a_h, None, noise)
    batches, delta_g = [1], None
    gate = 1 if alone.cost > tau_c else 0  # Eq. 9
    if gate == 0:
        batches.append(PROBE)
        samples = (STD * own.normal(PROBE, L, 1, purpose=PROBING)[0, :, :, 0]).clamp(-2, 2).tolist()
        found = [imagined(x, a_h, sample, noise) for sample in samples]
        safe = [i for i in range(PROBE) if found[i].cost <= tau_c]
        if safe:
            best = max(safe, key=lambda i: found[i].reward - ALPHA * found[i].effort)  # Eq. 11
            delta_g = found[best].reward - alone.reward  # Eq. 12
            gate = 2 if delta_g > tau_r else 0
    if gate == 0:
        return Outcome(0, a_h, alone.cost, alone.reward, delta_g, [], batches)
    normals = own.normal(ITERATIONS, N, L, 1, purpose=SEARCH)[0, :, :, :, 0]
    mean, std = [0.0] * L, [STD] * L
    tasks: list[tuple[float, list[float]]] = []
    safes: list[tuple[float, list[float]]] = []
    counts = []
    for batch in normals:
        batches.append(N)
        samples = [[min(2.0, max(-2.0, mean[k] + std[k] * float(n[k]))) for k in range(L)] for n in batch]
        found = [imagined(x, a_h, sample, noise) for sample in samples]
        feasible = [i for i in range(N) if found[i].cost <= tau_c]  # Eq. 14
        s_task = [f.reward - ALPHA * f.effort for f in found]  # Eq. 16
        s_safe = [max(0.0, f.cost - tau_c) + ALPHA * f.effort for f in found]  # Eq. 17
        counts.append(len(feasible))
        tasks += [(s_task[i], samples[i]) for i in feasible]
        safes += list(zip(s_safe, samples, strict=True))
        if len(feasible) >= N_F:
            elites = sorted(feasible, key=lambda i: -s_task[i])[:ELITES]
        else:
            elites = sorted(range(N), key=lambda i: s_safe[i])[:N_F]
        for k in range(L):
            values = [samples[i][k] for i in elites]
            mean[k] = sum(values) / len(values)
            std[k] = max(FLOOR, (sum((v - mean[k]) ** 2 for v in values) / len(values)) ** 0.5)
    batches.append(1)  # the operator alone once more, for the record
    chosen = max(tasks, key=lambda pair: pair[0])[1] if tasks else min(safes, key=lambda pair: pair[0])[1]
    return Outcome(gate, min(1.0, max(-1.0, a_h + chosen[0])), alone.cost, alone.reward, delta_g, counts, batches)  # Eq. 18


class Counted(Corridor):
    """Counts the rows of every rollout's first step. Any step may end the episode, and section 4 does not ask (Eq. 8)."""

    def __init__(self) -> None:
        super().__init__(LOW, HIGH, JITTER)
        self.calls: list[int] = []
        self.steps = 0

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        if self.steps % H == 0:
            self.calls.append(len(action) // M)
        self.steps += 1
        return super().imagine(latent, action, noise)

    def continues(self, latent: Latent) -> Tensor:
        return torch.full_like(latent.h[..., 0], 0.5)


CASES = [
    (0.28, 1.0, 0.8, 0.0, 1),  # the hazard is ahead
    (0.45, 0.1, 1e-6, 0.0, 1),  # nothing is safe: Case II throughout
    (-2.0, 0.3, 9.0, -1.0, 2),  # far away: the probe decides
    (-2.0, 0.3, 9.0, 50.0, 0),
    (-0.4, 0.9, 0.7, 0.2, 0),
]


@pytest.mark.parametrize(("x", "a_h", "tau_c", "tau_r", "gate"), CASES)
@pytest.mark.parametrize("how", [{"recipe": "paper"}, {"variant": "as-printed"}])
def test_a_decision_is_section_4_as_printed(how: dict[str, str], x: float, a_h: float, tau_c: float, tau_r: float, gate: int) -> None:
    world = Counted()
    config = WASPConfig.model_validate(SIZES | how | {"tau_r": tau_r})
    assistant = WASP(config, Imagination(world, LinearCritics(), config, GAMMA, OTHER, LAM), {"tau_c": tau_c})
    assistant.reset(torch.ones(1, dtype=torch.bool), [SEED])
    operator = Operator(lambda features: (0.9 - features[:, :1]).clamp(-1, 1), 1, EpisodeNoise([0]), 1)
    wanted = section_4(x, a_h, tau_c, tau_r)
    assert wanted.gate == gate
    decision = assistant.decide(world.at(x), torch.tensor([[a_h]]), operator)
    record, planned = decision.record, decision.planned
    assert record is not None
    assert planned is not None
    assert int(record.gate) == gate
    assert float(record.g_cost) == pytest.approx(wanted.g_cost, abs=1e-5)
    assert float(record.g_return) == pytest.approx(wanted.g_return, abs=1e-5)
    if wanted.delta_g is not None:
        assert float(record.delta_g) == pytest.approx(wanted.delta_g, abs=1e-5)
    assert world.calls == wanted.batches
    assert float(decision.action) == pytest.approx(wanted.action, abs=1e-4)
    if gate:
        assert planned.safe[0].tolist() == wanted.safe


def test_nothing_is_carried_over_to_the_next_decision() -> None:
    world = Counted()
    config = WASPConfig.model_validate(SIZES | {"recipe": "paper", "tau_r": 0.0})
    assistant = WASP(config, Imagination(world, LinearCritics(), config, GAMMA, OTHER, LAM), {"tau_c": 1e-6})
    operator = Operator(lambda features: (0.9 - features[:, :1]).clamp(-1, 1), 1, EpisodeNoise([0]), 1)
    assistant.reset(torch.ones(1, dtype=torch.bool), [SEED])
    start = world.at(0.45), torch.tensor([[0.1]]), operator
    assistant.decide(*start)
    assistant.noise.step = [0]  # the same draws again
    again = assistant.decide(*start).action
    assistant.reset(torch.ones(1, dtype=torch.bool), [SEED])
    assert torch.equal(assistant.decide(*start).action, again)


SECTION_4: dict[str, Any] = {
    "composition": "hold",  # Eq. 13
    "discounts": "reward", "bootstrap_cost": True, "bootstrap_reward": True, "continuation": False,  # Eq. 7-8
    "operator_model": "rule", "tau_c": "calibrated", "witness": "sum",  # Eq. 9
    "probe_with": "random", "rescore": False, "takeover_shares": (), "braking": False, "effort": "sampled", "alpha": 0.1,  # Eq. 11
    "tau_r_floor": 0.05,  # Eq. 12
    "probe_first": False, "task_search": True, "safety_search": True, "forced": False, "warm_start": False, "case2_memory": 0,
    "elites_kept": 0.0, "shrink": 1.0, "momentum": 0.0,  # Eq. 14-17
    "best_of": "all", "finalists": 0, "recheck": False,  # Eq. 18
}  # fmt: skip
"""What the recipe has to settle, written out: its own table would agree with itself."""


def test_the_recipe_settles_its_fields_whatever_they_say_and_the_variant_sets_it() -> None:
    otherwise = {"finalists": 4, "tau_c": 0.5, "rollouts": 3, "warm_start": True, "continuation": True, "tau_r_floor": 0.15}
    for how in ({"recipe": "paper"}, {"variant": "as-printed"}, {"variant": "as-printed", "recipe": "own"}):
        config = WASPConfig.model_validate(otherwise | how)
        assert config.recipe == "paper"
        assert {name: getattr(config, name) for name in SECTION_4} == SECTION_4
        assert config.gate_rollouts == 3  # one M
    own = WASPConfig()
    assert own.recipe == "own"
    assert all(getattr(own, name) != SECTION_4[name] for name in ("finalists", "recheck", "composition", "continuation", "tau_r_floor"))


def test_where_nothing_can_be_gained_the_calibrated_tau_r_is_the_recipe_s_floor() -> None:
    """Far from the goal the expert's command is the bound: no sample gains anything, in the recipe of the paper or in our own."""
    for how, floor in (({"recipe": "paper"}, 0.05), ({"probe_with": "random", "takeover_shares": (), "gate_rollouts": M}, 0.15)):
        config = WASPConfig.model_validate(SIZES | how)
        world = Corridor(LOW, HIGH, JITTER)
        assistant = WASP(config, Imagination(world, LinearCritics(), config, GAMMA, OTHER, LAM), {})
        zeros = torch.zeros(20)
        heldout = Heldout(world.at(*[-5.0] * 20), torch.ones(20, 1), zeros, zeros, zeros.long(), zeros)
        found = assistant.calibrate(
            heldout, zeros, Operator(lambda features: torch.ones_like(features[:, :1]), 1, EpisodeNoise([0] * 20), 20), 5
        )
        assert found["gain_p95"] <= 1e-6
        assert found["tau_r"] == floor
