"""The expert's takeovers as candidates: what they are in imagination, and what they are worth to whom.

B decisions, N candidates, L residual steps, M rollouts, H horizon.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.worlds import Corridor, LinearCritics
from wasp_cli.methods.base import Heldout
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.assistant import WASP
from wasp_cli.methods.wasp.candidates import takeovers
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Situation
from wasp_cli.methods.wasp.operator_model import imagined_operator
from wasp_cli.operators.base import DrawnNoise, EpisodeNoise, Operator
from wasp_cli.operators.laggy import LaggyOperator

H, L, M = 6, 3, 4
SIZES: dict[str, Any] = {
    "horizon": H, "residual_steps": L, "candidates": 16, "probe": 16, "elites": 4, "feasible": 4, "iterations": 2, "gate_rollouts": 8,
    "takeover_shares": (1.0, 0.5), "takeover_rollouts": 2,
}  # fmt: skip


def expert(features: Tensor) -> Tensor:
    return (0.9 - features[:, :1]).clamp(-1, 1)


def imagination(config: WASPConfig) -> Imagination:
    return Imagination(Corridor(5.0, 6.0, 0.05, torch.float64), LinearCritics(), config, 0.9, 0.8, 0.7, expert)


def laggy(last: float, p: float) -> LaggyOperator:
    operator = LaggyOperator(expert, 1, DrawnNoise(torch.zeros(1, 1, 1)), 1)
    operator.p = p
    operator.memory = {"last": torch.tensor([[last]], dtype=torch.float64), "started": torch.ones(1, 1, dtype=torch.bool)}
    return operator


def drawn(rollouts: int = M) -> Draws:
    source = torch.Generator().manual_seed(3)
    return Draws(
        torch.randn(1, H, rollouts, 2, generator=source, dtype=torch.float64),
        torch.rand(1, H, rollouts, 1, generator=source, dtype=torch.float64),
    )


def test_takeovers_are_of_the_next_one_to_l_commands_whole_and_in_part() -> None:
    share = takeovers(WASPConfig.model_validate(SIZES | {"braking": True}), 2)
    assert share.shape == (2, 3 * L, L, 2)
    assert share[0, :, :, 0].tolist() == [[1, 0, 0], [1, 1, 0], [1, 1, 1], [0.5, 0, 0], [0.5, 0.5, 0], [0.5, 0.5, 0.5], *[[0, 0, 0]] * L]
    assert share[0, 2 * L :, :, 1].tolist() == [[1, 0, 0], [1, 1, 0], [1, 1, 1]]


@pytest.mark.parametrize("share", [(1.0, 0.0), (0.5, 0.0), (0.0, 1.0)])
@pytest.mark.parametrize("length", [1, L])
def test_a_takeover_answers_in_every_rollout_what_the_operator_does_there(share: tuple[float, float], length: int) -> None:
    """Against plain numbers, rollout by rollout."""
    config, operator, draws = WASPConfig.model_validate(SIZES | {"bootstrap_reward": True}), laggy(-0.6, 0.5), drawn()
    model = imagination(config)
    start = Situation(model.model.at(0.2), torch.tensor([[-0.6]], dtype=torch.float64), operator, torch.arange(1))  # type: ignore[attr-defined]
    part = torch.zeros(1, 1, L, 2, dtype=torch.float64)
    part[0, 0, :length] = torch.tensor(share)
    returns, residuals, _ = model.rolled(start, torch.full((1, 1, L, 1), 9.0, dtype=torch.float64) * (part[..., :1] * 0), draws, part)
    effort, first, rewards = 0.0, [], 0.0
    for m in range(M):
        x, last, path, values = 0.2, -0.6, [], []
        for k in range(H):
            intended = min(1.0, max(-1.0, 0.9 - x))
            command = -0.6 if k == 0 else (last if float(draws.operator[0, k - 1, m, 0]) < 0.5 else intended)
            last = command
            action = command
            if k < length:
                action = command + share[0] * (intended - command) - share[1] * command
            effort += (action - command) ** 2 / M
            first += [action - command] if k == 0 else []
            x += 0.1 * action + 0.05 * float(draws.latent[0, k, m, 0])
            path.append(0.1 * action)
            values.append(0.5 * x)
        g = values[-1]
        for k in reversed(range(H)):
            g = path[k] + 0.9 * (0.3 * values[k] + 0.7 * g)
        rewards += g / M
    assert returns.effort.item() == pytest.approx(effort)
    assert returns.reward.item() == pytest.approx(rewards)
    assert residuals[0, 0, 0].item() == pytest.approx(first[0])
    assert (residuals[0, 0, length:] == 0).all()


def assisted(operator: Operator, x: float, a_h: float, **changes: Any) -> Any:
    config = WASPConfig.model_validate(SIZES | {"tau_r": 0.02, "alpha": 0.0} | changes)
    model = Imagination(Corridor(5.0, 6.0, 0.05), LinearCritics(), config, 0.9, 0.8, 0.7, expert)
    assistant = WASP(config, model, {})
    assistant.reset(torch.ones(1, dtype=torch.bool), [3])
    return assistant.decide(model.model.at(x), torch.tensor([[a_h]]), operator)  # type: ignore[attr-defined]


def test_the_gain_of_a_takeover_from_the_expert_is_exactly_nothing() -> None:
    a_h = float(expert(torch.tensor([[0.2]])))
    decision = assisted(Operator(expert, 1, EpisodeNoise([0]), 1), 0.2, a_h)
    assert decision.record.delta_g.item() == 0.0
    assert int(decision.record.gate) == 0
    assert decision.action.item() == torch.tensor(a_h).item()


def test_an_operator_who_drives_backwards_is_taken_over() -> None:
    operator = LaggyOperator(expert, 1, EpisodeNoise([0]), 1)
    operator.p = 0.9
    operator.memory = {"last": torch.tensor([[-0.9]]), "started": torch.ones(1, 1, dtype=torch.bool)}
    decision = assisted(operator, 0.0, -0.9)
    assert int(decision.record.gate) == 2
    assert decision.record.delta_g.item() > 0.1
    assert decision.action.item() > 0.5


def test_without_a_search_the_probes_winner_is_carried_out() -> None:
    operator = LaggyOperator(expert, 1, EpisodeNoise([0]), 1)
    operator.p = 0.9
    operator.memory = {"last": torch.tensor([[-0.9]]), "started": torch.ones(1, 1, dtype=torch.bool)}
    decision = assisted(operator, 0.0, -0.9, task_search=False)
    assert int(decision.record.gate) == 2
    assert decision.action.item() == pytest.approx(float(expert(torch.tensor([[0.0]]))))
    assert decision.planned.safe[0].tolist() == [-1, 2 * L]
    assert (decision.planned.residuals[0, :, 0] > 0.5).any()


def test_where_a_takeover_is_safe_the_safety_gate_needs_no_search() -> None:
    """Ahead is a hazard that the operator drives into and the expert does not; where the expert would too, a plan is searched."""
    for place, safe in ((1.0, [-1, 2 * L]), (0.2, None)):
        config = WASPConfig.model_validate(SIZES | {"safety_search": False})
        world = Corridor(place, 6.0)
        operator = Operator(lambda features: features[:, :1] * 0 + 1.0, 1, EpisodeNoise([0]), 1)
        assistant = WASP(config, Imagination(world, LinearCritics(), config, 0.9, 0.8, 0.7, lambda features: 0.7 - features[:, :1]), {})
        assistant.reset(torch.ones(1, dtype=torch.bool), [0])
        decision = assistant.decide(world.at(place - 0.45), torch.tensor([[1.0]]), operator)
        assert decision.record is not None
        assert decision.planned is not None
        assert int(decision.record.gate) == 1
        if safe is None:
            assert (decision.planned.safe[0] >= 0).all()
        else:
            assert decision.planned.safe[0].tolist()[0] == -1
            assert decision.action.item() < 1.0


def test_a_calibrated_tau_r_is_the_floor_since_the_expert_gains_nothing() -> None:
    config = WASPConfig.model_validate(SIZES)
    model = Imagination(Corridor(5.0, 6.0, 0.05), LinearCritics(), config, 0.9, 0.8, 0.7, expert)
    x = torch.linspace(-1, 1, 40)
    latent = model.model.at(*x.tolist())  # type: ignore[attr-defined]
    zeros = torch.zeros(40)
    heldout = Heldout(latent, expert(latent.features), zeros, zeros, zeros.long(), zeros)
    found = WASP(config, model, {}).calibrate(heldout, zeros, Operator(expert, 1, EpisodeNoise([0] * 40), 40), 5)
    assert found["tau_r"] == config.tau_r_floor
    assert found["gain_p95"] == 0.0
    random = config.model_copy(update={"probe_with": "random", "takeover_shares": ()})
    by_chance = WASP(random, Imagination(Corridor(5.0, 6.0, 0.05), LinearCritics(), random, 0.9, 0.8, 0.7), {})
    assert by_chance.calibrate(heldout, zeros, Operator(expert, 1, EpisodeNoise([0] * 40), 40), 5)["gain_p95"] > 0.0


def test_one_batch_serves_both_gates(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quiet decision is one series of rollouts: 8 of the operator alone and 2 of each takeover."""
    rows: list[int] = []
    original = Corridor.imagine

    def counted(self: Corridor, latent: Any, action: Tensor, noise: Tensor) -> Any:
        rows.append(len(action))
        return original(self, latent, action, noise)

    monkeypatch.setattr(Corridor, "imagine", counted)
    assisted(Operator(expert, 1, EpisodeNoise([0]), 1), 0.2, float(expert(torch.tensor([[0.2]]))))
    assert rows == [8 + 2 * 2 * L] * H


def test_the_operator_alone_meets_all_draws_of_the_gate() -> None:
    config = WASPConfig.model_validate(SIZES)
    model = imagination(config)
    operator = laggy(-0.6, 0.5)
    start = Situation(model.model.at(0.2), torch.tensor([[-0.6]], dtype=torch.float64), operator, torch.arange(1))  # type: ignore[attr-defined]
    draws = drawn(8)
    look = WASP(config, model, {})._seen(start, draws)
    nominal = model.nominal(start, draws)
    torch.testing.assert_close(look.nominal.reward, nominal.reward)
    torch.testing.assert_close(look.nominal.cost, nominal.cost)
    torch.testing.assert_close(look.baseline, model.nominal(start, draws.first(2)).reward)


@pytest.mark.parametrize(("kind", "wanted"), [("rule", [-0.6, -0.6]), ("expert", [0.7, 0.6]), ("hold", [-0.6, -0.6])])
def test_who_is_imagined_in_the_operators_place(kind: str, wanted: list[float]) -> None:
    operator = laggy(-0.6, 1.0)  # repeats itself for ever
    other = imagined_operator(kind, operator, torch.tensor([[-0.6]], dtype=torch.float64), expert)
    forked = other.fork(torch.zeros(1, dtype=torch.long), 1, DrawnNoise(torch.zeros(2, 1, other.draws)))
    found = [forked.command(torch.tensor([[x, 0.0]], dtype=torch.float64)).item() for x in (0.2, 0.3)]
    assert found == pytest.approx(wanted)


def test_the_imagined_operator_is_who_the_configuration_says() -> None:
    """A late driver who is about to turn back is no danger if one imagines the expert in his place."""
    costs = {}
    for kind in ("rule", "expert", "hold"):
        operator = LaggyOperator(lambda features: features[:, :1] * 0 + 1.0, 1, EpisodeNoise([0]), 1)
        operator.p = 0.0
        config = WASPConfig.model_validate(SIZES | {"operator_model": kind})
        model = Imagination(Corridor(0.3, 9.0), LinearCritics(), config, 0.9, 0.8, 0.7, lambda features: features[:, :1] * 0 - 1.0)
        assistant = WASP(config, model, {})
        assistant.reset(torch.ones(1, dtype=torch.bool), [0])
        costs[kind] = assistant.nominal(model.model.at(0.0), torch.tensor([[0.2]]), operator).cost.item()  # type: ignore[attr-defined]
    assert costs["rule"] > costs["hold"] == costs["expert"] == 0.0
