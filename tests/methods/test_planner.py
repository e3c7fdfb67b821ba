"""The planner alone: nobody's command is read, and its plans are no worse than the expert on
what it imagines.
"""

from typing import Any, get_args

import pytest
import torch
from torch import Tensor

from tests.artifacts import tiny_latents
from wasp_cli.errors import WaspError
from wasp_cli.learning.assistants import build_assistant
from wasp_cli.methods.base import Decision, Parts, checked
from wasp_cli.methods.configs import WASPVariant
from wasp_cli.methods.planner import Planner
from wasp_cli.methods.record import blank_record
from wasp_cli.methods.registry import METHODS, MethodInfo
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.operators.base import EpisodeNoise, OperatorContext, build_operator
from wasp_cli.store.tables import Thresholds

B, T = 6, 3
SMALL: dict[str, Any] = {
    "candidates": 24,
    "elites": 6,
    "feasible": 6,
    "iterations": 3,
    "rollouts": 2,
    "horizon": 6,
    "residual_steps": 3,
    "tau_c": 3.0,
    "tau_r": 0.0,
}


def drive(
    planner: Planner, parts: Parts, commands: Tensor, operator: str = "none"
) -> list[Decision]:
    """Decisions of T steps under commands [T, B, A] of some operator."""
    who = build_operator(
        operator, 0.5, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise(list(range(B))), B
    )
    planner.reset(torch.ones(B, dtype=torch.bool), list(range(B)))
    with torch.inference_mode():
        return [
            checked(planner.decide(tiny_latents(B, t), a_h, who), planner, a_h, a_h.clone())
            for t, a_h in enumerate(commands)
        ]


def planner(parts: Parts, **changes: Any) -> Planner:
    made = build_assistant("planner", SMALL | changes, parts)
    assert isinstance(made, Planner)
    return made


def test_its_actions_are_the_same_whatever_is_commanded_and_by_whom(parts):
    source = torch.Generator().manual_seed(9)
    first, second = (2 * torch.rand(T, B, 2, generator=source) - 1 for _ in range(2))
    one = drive(planner(parts), parts, first)
    other = drive(planner(parts), parts, second, "noisy")
    assert all(torch.equal(a.action, b.action) for a, b in zip(one, other, strict=True))
    assert any(
        (a.action - parts.skills.expert(tiny_latents(B, t).features)).abs().max() > 0.01
        for t, a in enumerate(one)
    )


def test_the_gate_is_set_where_the_action_is_not_the_command(parts):
    free = drive(planner(parts), parts, torch.zeros(T, B, 2))
    same = drive(planner(parts), parts, torch.stack([each.action for each in free]))
    for a, b in zip(free, same, strict=True):
        assert (a.record.gate == GATE_METHOD).all()
        assert (b.record.gate == 0).all()
        assert torch.equal(a.action, b.action)


def test_plans_gain_over_the_expert_and_keep_to_the_bound(parts, monkeypatch):
    made, chosen, alone = planner(parts, alpha=0.0), [], []
    real = made._search

    def search(*arguments: Any) -> Any:
        plan = real(*arguments)
        chosen.append((plan.reward, plan.cost))
        alone.append((plan.alone_reward, plan.alone_cost))
        return plan

    monkeypatch.setattr(made, "_search", search)
    drive(made, parts, torch.zeros(T, B, 2))
    reward, cost = (torch.stack(each) for each in zip(*chosen, strict=True))
    before, risk = (torch.stack(each) for each in zip(*alone, strict=True))
    fine = risk <= 3.0
    assert fine.any()
    assert (reward >= before)[fine].all()
    assert (reward > before)[fine].any()
    assert (cost <= 3.0)[fine].all()


def test_a_plan_replaces_the_experts_safe_actions_only_where_it_gains_tau_r(parts, monkeypatch):
    def plans(tau_r: float) -> list[Any]:
        made, found = planner(parts, alpha=0.0, tau_r=tau_r, tau_c=1e6), []
        real = made._search
        monkeypatch.setattr(
            made, "_search", lambda *arguments: found.append(real(*arguments)) or found[-1]
        )
        drive(made, parts, torch.zeros(T, B, 2))
        return found

    gains = torch.cat([plan.reward - plan.alone_reward for plan in plans(0.0)])
    bar = float(gains.median())
    assert 0 < bar < float(gains.max())
    changed = 0
    for plan in plans(bar):
        acts = (plan.residuals != 0).any(-1).any(-1)
        assert (plan.reward - plan.alone_reward > bar)[acts].all()
        changed += int(acts.sum())
    assert 0 < changed < T * B


# What the closed loop asks of every decision.


COMMANDS = torch.tensor([[0.5, -0.5], [0.0, 1.0]])
CHANGED = torch.tensor([[0.5, -0.5], [0.0, 0.9]])


class Mine:
    """The assistant that is named in messages."""


def test_a_command_may_change_where_a_gate_fired():
    record = blank_record(2)
    record.gate[1] = 3
    decision = Decision(CHANGED, record)
    assert checked(decision, Mine(), COMMANDS, COMMANDS.clone()) is decision


@pytest.mark.parametrize(
    ("decision", "message"),
    [
        (CHANGED, "'Mine' returned a Tensor, not a Decision"),
        (Decision(CHANGED), "'Mine' changed a command without a record"),
        (Decision(CHANGED, blank_record(2)), "although its record says that no gate fired"),
        (Decision(CHANGED[0]), r"shape \[2\] for commands of shape \[2, 2\]"),
    ],
)
def test_what_breaks_the_contract_is_said(decision, message):
    with pytest.raises(WaspError, match=message):
        checked(decision, Mine(), COMMANDS, COMMANDS.clone())


@pytest.mark.parametrize("to", [0.0, torch.nan])
def test_a_command_that_was_changed_in_place_is_refused(to):
    """What is recorded as the command would be what the assistant made of it, without any
    intervention.
    """
    commands = COMMANDS.clone()
    given = commands.clone()
    commands[1] = to
    with pytest.raises(WaspError, match="'Mine' changed the operator's command in place"):
        checked(Decision(commands), Mine(), commands, given)


# What registry entries say of assistants, and what is no configuration.


@pytest.mark.parametrize("name", METHODS)
def test_an_entry_says_how_its_method_decides(name):
    info = METHODS[name]
    assert info.rule.endswith(".")
    config = info.config_model()

    limit = info.signal.limit
    assert not limit or limit in vars(Thresholds()) or limit in config.model_fields
    if len(info.variants) > 1:
        assert "variant" in config.model_fields


def test_the_variants_of_wasp_are_those_of_its_configuration():
    assert (
        tuple(METHODS["printed"].variants)
        == tuple(METHODS["wasp"].variants)
        == get_args(WASPVariant)
    )


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ("wasp_cli.methods.human:HumanOnly", "is no configuration"),
        ("wasp_cli.methods.human:Nobody", "does not load"),
        ("wasp_cli.methods.nowhere:Config", "does not load"),
    ],
)
def test_what_is_no_configuration_is_said(config, message):
    with pytest.raises(WaspError, match=message):
        MethodInfo("mine", "Mine", "wasp_cli.methods.human:HumanOnly", config).config_model()
