"""The second witness of the safety gate: whom it hears, and when the gate fires."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.artifacts import SIZES, tiny_artifacts
from wasp_cli.errors import WaspError
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.configs import ReturnsConfig
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.assistant import WASP
from wasp_cli.methods.wasp.gates import safety_gate
from wasp_cli.methods.wasp.imagine import Draws, Returns, Situation
from wasp_cli.methods.wasp.witness import Witness, load_witness
from wasp_cli.models.base import Latent
from wasp_cli.models.lookahead import LookAhead
from wasp_cli.operators.base import DrawnNoise, EpisodeNoise, OperatorContext, build_operator
from wasp_cli.operators.laggy import LaggyOperator

SMALL: dict[str, Any] = {
    "horizon": 4, "residual_steps": 2, "candidates": 6, "elites": 2, "feasible": 2, "iterations": 1, "probe": 6, "gate_rollouts": 4,
    "takeover_rollouts": 2, "finalists": 1, "tau_r": 10.0,
}  # fmt: skip
BATCH = 3


def returns(cost: Sequence[float]) -> Returns:
    return Returns(torch.zeros(len(cost)), torch.tensor(cost), torch.zeros(len(cost)))


@pytest.mark.parametrize(
    ("witness", "fires"),
    [
        ("sum", [False, False, False, False, True, True, True, True]),
        ("head", [False, False, True, True, False, False, True, True]),
        ("both", [False, False, False, False, False, True, True, True]),
    ],
)
def test_who_must_speak_before_the_gate_fires(witness: str, fires: list[bool]) -> None:
    config = WASPConfig(witness=witness, tau_head=0.3)
    cost = returns([0.4] * 4 + [0.6] * 4)
    foreseen = torch.tensor([0.3, 0.3, 0.31, 0.31] * 2)
    before = torch.tensor([False, True] * 4)
    assert safety_gate(cost, config, 0.5, foreseen, before).tolist() == fires
    quiet = config.model_copy(update={"variant": "task-only"})
    assert not safety_gate(cost, quiet, 0.5, foreseen, before).any()


class Counted(LookAhead):
    """Within k decisions a cost is as probable as k / 10 times the sum of the commands that it reads."""

    def __init__(self) -> None:
        super().__init__(1, 1, 1, 2, [1], 3)

    def forward(self, features: Tensor, commands: Tensor) -> Tensor:
        total: Tensor = features.sum(-1) + commands[:, :2].sum((1, 2))
        return total.unsqueeze(-1) * torch.arange(1, 4) / 10


def test_a_witness_says_the_mean_over_the_imagined_futures() -> None:
    latent = Latent(torch.tensor([[1.0], [0.0]]), torch.zeros(2, 0))
    issued = torch.tensor([[[0.1, 0.3, 9.0], [0.5, 0.1, 9.0]], [[0.0, 0.0, 9.0], [0.0, 1.0, 9.0]]]).unsqueeze(-1)
    found = Witness(Counted(), 2).foreseen(latent, issued)
    assert found == pytest.approx(torch.tensor([0.2 * 1.5, 0.2 * 0.5]))


def assistant(folders: dict[str, Path], **changes: Any) -> WASP:
    parts = load_parts(folders, ReturnsConfig())
    made = build_assistant("wasp", {**SMALL, **changes}, parts)
    assert isinstance(made, WASP)
    return made


def situation(wasp: WASP, folders: dict[str, Path], variant: str = "laggy", value: float = 0.5) -> Situation:
    torch.manual_seed(1)
    skills = load_parts(folders, ReturnsConfig()).skills
    operator = build_operator(variant, value, OperatorContext(skills.at, 2, 0.08), EpisodeNoise([5, 6, 7]), BATCH)
    z = torch.nn.functional.one_hot(torch.randint(SIZES.classes, (BATCH, SIZES.variables)), SIZES.classes).float().flatten(1)
    latent = Latent(torch.randn(BATCH, SIZES.deter), z)
    return Situation(latent, operator.command(latent.features).clamp(-1, 1), operator, torch.arange(BATCH))


@pytest.mark.parametrize("shares", [(1.0, 0.5), ()])
def test_it_hears_the_commands_that_the_operator_alone_issues_in_the_gate_s_rollouts(tmp_path: Path, shares: tuple[float, ...]) -> None:
    folders = tiny_artifacts(tmp_path)
    changes: dict[str, Any] = {} if shares else {"probe_with": "random"}
    wasp = assistant(folders, witness="both", takeover_shares=shares, **changes)
    start = situation(wasp, folders)
    heard: list[Tensor] = []

    class Listening(Witness):
        def foreseen(self, latent: Latent, issued: Tensor) -> Tensor:
            heard.append(issued)
            return super().foreseen(latent, issued)

    assert wasp.witness is not None
    wasp.witness = Listening(wasp.witness.model, wasp.witness.window)
    model = wasp.imagination.model
    draws = Draws(torch.rand(BATCH, 4, 4, model.noise_size), torch.rand(BATCH, 4, 4, 1))
    look = wasp._seen(start, draws)
    # The same by hand: the operator forked from its memory, step by step.
    assert isinstance(start.operator, LaggyOperator)
    uniforms, noise = (part.transpose(1, 2).reshape(BATCH * 4, 4, -1).transpose(0, 1) for part in (draws.operator, draws.latent))
    forked = start.operator.fork(torch.arange(BATCH), 4, DrawnNoise(uniforms))
    latent, command = start.latent.expand_rows(4), start.a_h.repeat_interleave(4, 0)
    expected = [command]
    for k in range(2):
        latent = model.imagine(latent, command, noise[k])
        command = forked.command(latent.features)
        expected.append(command)
    assert heard[0].shape == (BATCH, 4, 3, 2)
    assert torch.allclose(heard[0].flatten(0, 1), torch.stack(expected, 1), atol=1e-6)
    assert look.foreseen is not None
    assert torch.allclose(look.foreseen, Witness(wasp.witness.model, wasp.witness.window).foreseen(start.latent, heard[0]))


def test_both_fire_at_the_second_decision_in_a_row_at_the_latest_and_an_episode_forgets_the_last_one(tmp_path: Path) -> None:
    folders = tiny_artifacts(tmp_path)
    wasp = assistant(folders, witness="both", tau_head=0.999, tau_c=1e-6)  # the sum always speaks, the head never
    start = situation(wasp, folders)
    everyone = torch.ones(BATCH, dtype=torch.bool)

    def gates(reset: Tensor) -> list[bool]:
        wasp.reset(reset, [1, 2, 3])
        record = wasp.decide(start.latent, start.a_h, start.operator).record
        assert record is not None
        return (record.gate == 1).tolist()

    assert gates(everyone) == [False] * 3
    assert gates(~everyone) == [True] * 3
    assert gates(torch.tensor([False, True, False])) == [True, False, True]
    wasp = assistant(folders, witness="both", tau_head=0.0, tau_c=1e-6)  # both speak at once
    assert gates(everyone) == [True] * 3


def test_the_command_s_own_gate_needs_no_look_ahead(tmp_path: Path) -> None:
    folders = tiny_artifacts(tmp_path)
    del folders["lookahead"]
    assert assistant(folders).witness is None
    assert assistant(folders, variant="no-rollout", witness="both").witness is None
    assert assistant(folders, variant="as-printed", witness="both").witness is None
    plain = assistant(folders)
    asking = plain.imagination.__class__(**{**plain.imagination.__dict__, "config": plain.config.model_copy(update={"witness": "head"})})
    with pytest.raises(WaspError, match="there is no look ahead here"):
        WASP(asking.config, asking, {})


@pytest.mark.parametrize(("changes", "message"), [({"head_window": 16}, "ends after 15"), ({"horizon": 2}, "reads 3 commands")])
def test_a_look_ahead_that_does_not_fit_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    folder = tiny_artifacts(tmp_path)["lookahead"]
    with pytest.raises(WaspError, match=message):
        load_witness(WASPConfig(**{**SMALL, "witness": "both", **changes}), folder)
