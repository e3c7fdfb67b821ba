"""Clones of operators: densities, what is learned of a rule that is known, what is imagined, and the stage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from wasp_cli.methods.wasp.operator_model import imagined_operator, load_clone

from tests.artifacts import tiny_artifacts
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.clone import Foreteller, Issued, fit_clone, issued, judged, log_score
from wasp_cli.learning.closed_loop import Loop
from wasp_cli.learning.configs import CloneConfig, ReturnsConfig
from wasp_cli.methods.wasp.assistant import WASP
from wasp_cli.models.base import Latent
from wasp_cli.models.clone import Clone
from wasp_cli.models.weights import save_weights
from wasp_cli.operators.base import DrawnNoise, EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.operators.cloned import ClonedOperator
from wasp_cli.plan.grid import lay_out
from wasp_cli.spec.model import validate
from wasp_cli.stages.base import Job, no_progress
from wasp_cli.stages.clone import CloneStage

FEATURES, ACTIONS = 3, 2


def expert(features: Tensor) -> Tensor:
    return (0.8 * features[:, :ACTIONS]).clamp(-1, 1)


def driven(variant: str, value: float, rows: int = 16, decisions: int = 120) -> Issued:
    """What an operator issues for random features: a different episode in every row."""
    source = torch.Generator().manual_seed(0)
    context = OperatorContext(lambda fraction: expert, ACTIONS, 0.08)
    operator = build_operator(variant, value, context, EpisodeNoise(list(range(rows))), rows)
    parts, last = [], torch.full((rows, ACTIONS), torch.nan)
    for _ in range(decisions):
        seen = torch.randn(rows, FEATURES, generator=source)
        command = operator.command(seen).clamp(-1, 1)
        parts.append(Issued(seen, command, last))
        last = command
    return Issued(*(torch.cat(fields) for fields in zip(*parts, strict=True)))


def learned(seen: Issued, updates: int = 400) -> Clone:
    torch.manual_seed(0)
    config = CloneConfig(hidden=(16,), updates=updates, learning_rate=1e-2)
    return fit_clone(seen, expert, config, 0, no_progress)[0]


@pytest.mark.parametrize(
    ("variant", "value", "ways"), [("laggy", 0.7, [0.7, 0.3, 0.0]), ("noisy", 0.4, [0.0, 0.6, 0.4]), ("laggy", 0.0, [0.0, 1.0, 0.0])]
)
def test_it_learns_how_often_an_operator_repeats_and_slips(variant: str, value: float, ways: list[float]) -> None:
    clone = learned(driven(variant, value))
    assert clone.weight_logits.softmax(-1).tolist() == pytest.approx(ways, abs=0.05)
    assert clone.spread.max() < 0.1


def test_it_learns_what_an_operator_intends_where_that_is_not_the_expert_s() -> None:
    seen = driven("laggy", 0.0)
    own = (0.8 * seen.features[:, 1:] - 0.2).clamp(-1, 1)
    clone = learned(seen._replace(command=own), updates=1500)
    error = (clone.intended(seen.features, seen.last, expert(seen.features)) - own).square().mean()
    assert error < 0.1 * (expert(seen.features) - own).square().mean()


def test_densities_integrate_to_one_within_the_bounds_and_draws_follow_them() -> None:
    torch.manual_seed(0)
    clone = Clone(FEATURES, [4], 1)
    clone.log_spread.data.fill_(np.log(0.1))
    clone.weight_logits.data[:] = torch.tensor([0.4, 0.5, 0.1]).log()
    line = torch.linspace(-1, 1, 4001).unsqueeze(1)
    one = torch.zeros(1, FEATURES), torch.tensor([[0.4]]), torch.tensor([[-0.2]])
    clone.requires_grad_(False)
    density = clone.log_density(line, *(part.expand(len(line), -1) for part in one)).exp()
    assert float(torch.trapezoid(density, line[:, 0])) == pytest.approx(1.0, abs=0.01)
    many = tuple(part.expand(20_000, -1) for part in one)
    drawn = clone.sample(*many, torch.rand(20_000, 2))
    assert float((drawn == 0.4).float().mean()) == pytest.approx(0.4, abs=0.02)
    assert float(((drawn + 0.2).abs() < 0.3).float().mean()) == pytest.approx(0.5 + 0.1 * 0.3, abs=0.02)
    assert float(clone.mean(*one)) == pytest.approx(float(drawn.mean()), abs=0.02)


def test_before_the_first_command_nothing_is_repeated_and_nothing_is_undefined() -> None:
    clone = Clone(FEATURES, [4], ACTIONS)
    clone.weight_logits.data[:] = torch.tensor([9.0, 0.0, 0.0])
    seen, last = torch.randn(50, FEATURES), torch.full((50, ACTIONS), torch.nan)
    drawn = clone.sample(seen, last, expert(seen), torch.rand(50, 1 + ACTIONS))
    assert drawn.isfinite().all()
    assert clone.log_weights(last).exp()[0].tolist() == pytest.approx([0.0, 0.5, 0.5])
    clone.log_density(drawn, seen, last, expert(seen)).sum().backward()
    assert all(part.grad is None or part.grad.isfinite().all() for part in clone.parameters())


def test_an_imagined_clone_goes_on_from_the_command_just_issued() -> None:
    clone = Clone(FEATURES, [4], ACTIONS)
    clone.weight_logits.data[:] = torch.tensor([20.0, 0.0, 0.0])  # it repeats
    waiting = ClonedOperator(clone, expert, ACTIONS, DrawnNoise(torch.zeros(0, 0, 0)), 0)
    context = OperatorContext(lambda fraction: expert, ACTIONS, 0.08)
    real = build_operator("laggy", 0.5, context, EpisodeNoise([0, 1]), 2)
    a_h = torch.tensor([[0.1, 0.2], [0.3, 0.4]])
    imagined = imagined_operator("cloned", real, a_h, expert, waiting)
    forked = imagined.fork(torch.tensor([1, 0]), 2, DrawnNoise(torch.full((3, 4, imagined.draws), 0.5)))
    for _ in range(3):
        assert torch.equal(forked.command(torch.randn(4, FEATURES)), a_h[[1, 1, 0, 0]])
    assert torch.equal(imagined.memory["last"], a_h)  # the copies remember for themselves
    with pytest.raises(ValueError, match="no clone"):
        imagined_operator("cloned", real, a_h, expert)


def loop(alive: list[list[bool]], a_h: Tensor, latent: Latent) -> Loop:
    empty = np.zeros((len(alive), 2))
    return Loop(
        empty, empty, empty, empty, empty, np.array(alive), empty, a_h.numpy(), a_h.numpy(), [], np.zeros(3), latent.h, latent.z
    )  # fmt: skip


def test_commands_follow_the_last_one_of_their_own_episode_and_end_with_it() -> None:
    a_h = torch.arange(12.0).view(3, 2, 2) / 12
    latent = Latent(torch.rand(3, 2, 2), torch.rand(3, 2, 1))
    seen = issued(loop([[True, True], [True, True], [True, False]], a_h, latent))
    assert torch.equal(seen.command, torch.stack([a_h[0, 0], a_h[0, 1], a_h[1, 0], a_h[1, 1], a_h[2, 0]]))
    assert seen.last[:2].isnan().all()
    assert torch.equal(seen.last[2:], torch.stack([a_h[0, 0], a_h[0, 1], a_h[1, 0]]))
    assert torch.equal(seen.features[4], torch.cat([latent.h[2, 0], latent.z[2, 0]]))


class Says(Operator):
    """Always the same command."""

    def command(self, features: Tensor) -> Tensor:
        return torch.full((len(features), ACTIONS), 0.5)


def test_who_foretells_the_next_command_scores_and_who_does_not_errs() -> None:
    seen: list[Tensor] = []

    class Told(Says):
        def observe(self, executed: Tensor) -> None:
            seen.append(executed)

    def model(operator: Operator, a_h: Tensor) -> Operator:
        return Told(expert, ACTIONS, DrawnNoise(torch.zeros(0)), len(a_h))

    told = Foreteller({"says": model}, 4, 0)
    commands = torch.tensor([[[0.0, 0.0]] * 2, [[0.5, 0.5], [0.5, 0.0]], [[9.0, 9.0]] * 2])
    latent = Latent(torch.zeros(2, 2), torch.zeros(2, 1))
    for a_h in commands:
        assert torch.equal(told.decide(latent, a_h, Says(expert, ACTIONS, DrawnNoise(torch.zeros(0)), 2)).action, a_h)
    assert torch.equal(torch.stack(seen), commands.repeat_interleave(4, 1))  # every draw goes on from what was executed
    found = judged(told, loop([[True, True], [True, True], [False, False]], commands, Latent(torch.zeros(3, 2, 2), torch.zeros(3, 2, 1))))
    assert found["says"]["squared_error"] == pytest.approx((0.0 + 0.25) / 2)
    best, far = log_score(torch.full((2, 4, ACTIONS), 0.5), commands[1]).tolist()
    assert best == pytest.approx(np.log(0.99 / (2 * np.pi * 0.01) + 0.01 / 4))
    assert far == pytest.approx(np.log(0.99 / (2 * np.pi * 0.01) * np.exp(-12.5) + 0.01 / 4))
    assert found["says"]["log_score"] == pytest.approx((best + far) / 2)


DOCUMENT: dict[str, Any] = {
    "name": "x", "preset": "smoke", "tasks": ["goal1"], "methods": ["human", "wasp"], "seeds": [0],
    "operators": {"laggy": {"low": 0.5, "high": 0.7}, "noisy": {"some": 0.4}},
}  # fmt: skip


def test_every_cell_reads_the_clone_of_its_own_operator_and_calibrations_that_of_the_unimpaired_one() -> None:
    grid = lay_out(validate({**DOCUMENT, "wasp": {"operator_model": "cloned"}}))
    for cell, node in grid.cells:
        clone = node.needs.get("clone")
        assert (clone is not None) == (cell.method == "wasp")
        if clone is not None:
            assert (clone.axes["variant"], clone.axes["value"]) == (cell.operator, cell.value)
            assert node.needs["calibration"].needs["clone"].axes["value"] is None
    clones = [node for node in grid.nodes if node.kind == "clone"]
    assert len({node.key for node in clones}) == len(clones) == 3 + 1  # that of the unimpaired operator too
    assert not [node for node in lay_out(validate(DOCUMENT)).nodes if node.kind == "clone"]


def test_a_spec_cannot_ask_for_a_clone_by_name() -> None:
    with pytest.raises(Exception, match="runs for an operator"):
        validate({**DOCUMENT, "stages": ["clone"]})


def test_wasp_imagines_the_clone_where_it_is_told_to(tmp_path: Path) -> None:
    folders = tiny_artifacts(tmp_path) | {"clone": tmp_path / "clone"}
    parts = load_parts(folders, ReturnsConfig())
    size = parts.world_model.feature_size
    folders["clone"].mkdir()
    save_weights(Clone(size, [4], 2), folders["clone"] / "clone.safetensors", features=size, hidden=[4], action=2)
    waiting = load_clone(folders["clone"], parts.skills.expert, 2)
    sizes: dict[str, Any] = {"candidates": 6, "elites": 2, "feasible": 2, "iterations": 1, "probe": 6, "finalists": 1}
    wasp = build_assistant("wasp", {**sizes, "operator_model": "cloned"}, parts)
    assert isinstance(wasp, WASP)
    assert isinstance(wasp.clone, ClonedOperator)
    context = OperatorContext(parts.skills.at, 2, 0.08)
    real = build_operator("laggy", 0.5, context, EpisodeNoise([0, 1]), 2)
    latent, a_h = Latent(torch.zeros(2, 12), torch.zeros(2, 8)), torch.tensor([[0.1, 0.2], [0.3, 0.4]])
    assert wasp.clone.draws == waiting.draws == 3
    wasp.reset(torch.ones(2, dtype=torch.bool), [0, 1])
    assert wasp.decide(latent, a_h, real).action.isfinite().all()
    start = wasp._situation(latent, a_h, real)
    assert isinstance(start.operator, ClonedOperator)
    assert torch.equal(start.operator.memory["last"], a_h)


@pytest.mark.parametrize(("variant", "value"), [("noisy", 0.5), ("none", None)])
def test_the_stage_leaves_a_clone_and_what_it_is_worth(tmp_path: Path, variant: str, value: float | None) -> None:
    folders = tiny_artifacts(tmp_path / "parts")
    config = CloneConfig(episodes=1, heldout_episodes=1, hidden=(4,), updates=300, batch=64, draws=128)
    axes = {"variant": variant, "value": value}
    out = tmp_path / "out"
    out.mkdir()
    job = Job("clone", "goal1", 0, config, {"action_repeat": 4}, axes, folders, out, tmp_path)
    summary = CloneStage().run(job)
    quality = json.loads((out / "quality.json").read_text())
    assert set(quality["models"]) == {"cloned", "rule", "expert", "hold"}
    assert summary["rule_log_score"] == round(quality["models"]["rule"]["log_score"], 3)
    assert sum(quality["ways"].values()) == pytest.approx(1.0, abs=1e-5)
    parts = load_parts(folders, ReturnsConfig())
    assert load_clone(out, parts.skills.expert, 2).clone.action == 2
    if variant == "noisy":
        # Every other command is anything at all: who takes it for the expert's is surprised.
        assert summary["rule_log_score"] > summary["expert_log_score"] + 0.5
        assert summary["cloned_log_score"] > summary["expert_log_score"] + 0.5
