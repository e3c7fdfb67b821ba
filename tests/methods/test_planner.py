"""The planner alone: nobody's command is read, and its plans are no worse than the expert on what it imagines."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tests.report.invented import invent, write, write_grid
from wasp_cli.learning.assistants import build_assistant
from wasp_cli.methods.base import Decision, Parts, checked
from wasp_cli.methods.planner import Planner
from wasp_cli.methods.registry import METHODS
from wasp_cli.methods.wasp.imagine import Scored
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.report.stats import read_frame
from wasp_cli.report.summary import UNDEFINED
from wasp_cli.report.tables.main import OF_COMMANDS, autonomy_table, detail_table, main_table
from wasp_cli.store.tables import CellIdentity

B, T = 6, 3
SMALL: dict[str, Any] = {
    "candidates": 24, "elites": 6, "feasible": 6, "iterations": 3, "rollouts": 2, "horizon": 6, "residual_steps": 3,
    "tau_c": 3.0, "tau_r": 0.0,
}  # fmt: skip


def latents(step: int) -> Latent:
    source = torch.Generator().manual_seed(step)
    z = torch.nn.functional.one_hot(torch.randint(4, (B, 2), generator=source), 4).float().flatten(1)
    return Latent(torch.randn(B, 12, generator=source), z)


def drive(planner: Planner, parts: Parts, commands: Tensor, operator: str = "none") -> list[Decision]:
    """Decisions of T steps under commands [T, B, A] of some operator."""
    who = build_operator(operator, 0.5, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise(list(range(B))), B)
    planner.reset(torch.ones(B, dtype=torch.bool), list(range(B)))
    with torch.inference_mode():
        return [checked(planner.decide(latents(t), a_h, who), planner, a_h, a_h.clone()) for t, a_h in enumerate(commands)]


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
    assert any((a.action - parts.skills.expert(latents(t).features)).abs().max() > 0.01 for t, a in enumerate(one))


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


def test_where_everything_costs_too_much_the_plan_costs_less_than_the_expert(parts, monkeypatch):
    made, found = planner(parts, tau_c=1e-6, alpha=0.0), []
    real = made._search
    monkeypatch.setattr(made, "_search", lambda *arguments: found.append(real(*arguments)) or found[-1])
    drive(made, parts, torch.zeros(T, B, 2))
    assert all((plan.cost <= plan.alone_cost).all() for plan in found)
    assert any((plan.cost < plan.alone_cost).any() for plan in found)


def test_a_plan_replaces_the_experts_safe_actions_only_where_it_gains_tau_r(parts, monkeypatch):
    def plans(tau_r: float) -> list[Any]:
        made, found = planner(parts, alpha=0.0, tau_r=tau_r, tau_c=1e6), []
        real = made._search
        monkeypatch.setattr(made, "_search", lambda *arguments: found.append(real(*arguments)) or found[-1])
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


def test_the_expert_drives_where_no_plan_gains(parts, monkeypatch):
    made = planner(parts, tau_r=1e6, tau_c=1e6)
    decisions = drive(made, parts, torch.zeros(T, B, 2))
    for t, each in enumerate(decisions):
        assert torch.equal(each.action, parts.skills.expert(latents(t).features).clamp(-1, 1))


def test_ended_episodes_cost_no_search(parts, monkeypatch):
    made, sizes = planner(parts), []
    real = made._scored

    def scored(start: Any, *arguments: Any, **named: Any) -> Scored:
        sizes.append(len(start.a_h))
        return real(start, *arguments, **named)

    monkeypatch.setattr(made, "_scored", scored)
    made.reset(torch.ones(B, dtype=torch.bool), list(range(B)))
    made.rest(torch.arange(B) >= 2)
    with torch.inference_mode():
        made.decide(latents(0), torch.zeros(B, 2), Operator(parts.skills.expert, 2, EpisodeNoise([0] * B), B))
    assert set(sizes) == {2}


def test_it_is_a_reference_row_without_a_calibrated_threshold(parts):
    info = METHODS["planner"]
    assert (info.impaired, info.intervenes, info.attended, info.calibrated) == (False, False, False, False)
    assert Planner(planner(parts).config, replace(parts, thresholds={"tau_c": 9.0})).tau_c == 3.0


def test_its_row_has_no_numbers_that_compare_with_commands(tmp_path):
    wanted = write_grid(tmp_path, seeds=(0,))
    wanted.append(write(tmp_path, CellIdentity("goal1", "planner", "full", "none", None, 0), [invent(0, 12, 0.5, 0.02)]))
    frame = read_frame(wanted)
    for table in (main_table(frame), autonomy_table(frame), detail_table(frame)):
        shown = {row.labels[1]: dict(zip((column.key for column in table.columns), row.values, strict=True)) for row in table.rows}
        for key, value in shown["Planner alone"].items():
            assert value == UNDEFINED if key in OF_COMMANDS else (not value.ranked)
            assert shown["Expert"][key].mean is not None or key in ("mag_int", "jump", "safety_gate", "task_gate", "case2")
    main = main_table(frame)
    row = next(row for row in main.rows if row.labels[1] == "Planner alone")
    numbers = dict(zip((column.key for column in main.columns), row.values, strict=True))
    assert all(numbers[key].mean is not None for key in ("return", "success", "cost", "viol"))
    assert any("Planner alone drives with nobody at the controls" in line for line in main.meanings)
    assert not any("Planner alone" in line for line in main_table(read_frame(wanted[:-1])).meanings)
