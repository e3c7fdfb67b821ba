from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.artifacts import tiny_artifacts
from tests.cells import REPEAT, SETTINGS
from wasp_cli.errors import WaspError
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.configs import CalibrationConfig, CoverageConfig, HeldoutConfig, ReturnsConfig
from wasp_cli.learning.coverage import BATCH, Facts, foreseen, load_drives, mixture_of, operator_of, record_drives
from wasp_cli.methods.base import Decision
from wasp_cli.methods.configs import Coverage, WASPConfig
from wasp_cli.methods.wasp.assistant import TAU_C as TAU_C_FALLBACK
from wasp_cli.metrics.coverage import episode_score
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator, OperatorContext
from wasp_cli.seeds import derive
from wasp_cli.stages.base import Job
from wasp_cli.stages.calibration import CalibrationStage
from wasp_cli.stages.coverage import CoverageStage
from wasp_cli.stages.heldout import HeldoutStage
from wasp_cli.tasks.base import Step, VectorTask
from wasp_cli.tasks.make import make_task

MIXTURE = [("laggy", 0.7), ("limited-skill", 0.25), ("noisy", 0.4), ("reaction-time", 0.8)]
STREAM = ("race1", 0)
SMALL = {
    "horizon": 4, "residual_steps": 2, "candidates": 8, "elites": 3, "feasible": 3, "iterations": 2, "rollouts": 4,
}  # fmt: skip


def quiet(share: float, text: str) -> None:
    pass


def test_a_mixture_has_every_severity_that_can_be_built() -> None:
    operators = {"noisy": (0.2, 0.6), "limited-skill": (0.5, 0.25), "laggy": (0.7,)}
    assert mixture_of(operators, (0.25, 1.0)) == [("laggy", 0.7), ("limited-skill", 0.25), ("noisy", 0.2), ("noisy", 0.6)]


def test_a_gate_reads_in_recorded_episodes_what_it_reads_while_the_operators_drive(inputs: Mapping[str, Path]) -> None:
    """Operators with memory, and a delayed one, are played again from their seeds."""
    parts = load_parts(inputs, ReturnsConfig())
    batch, episodes = 4, 6
    task = make_task("race1", batch, action_repeat=REPEAT, observe=("pixels",))
    drives = record_drives(task, parts.world_model, parts.skills, MIXTURE, episodes, STREAM, quiet)
    assert drives.operator.unique().numel() > 1
    assistant: Any = build_assistant("wasp", {**SMALL, "variant": "knows-operator"}, parts)
    facts = Facts(MIXTURE, task.decision_seconds, episodes)
    with torch.inference_mode():
        found = foreseen(assistant, drives, facts, parts.skills, STREAM, batch=5)

    live = run_live(task, assistant, parts, drives.operator[:batch], drives.seed[:batch].tolist())
    for number in range(batch):
        rows = drives.episode == number
        assert torch.equal(drives.a_h[rows], live.a_h[number])
        np.testing.assert_allclose(found[number], live.read[number], rtol=1e-4, atol=1e-6)
    other = drives._replace(operator=(drives.operator + 1) % len(MIXTURE))
    with torch.inference_mode():
        wrong = foreseen(assistant, other, facts, parts.skills, STREAM, batch=5)
        blind: Any = build_assistant("wasp", {**SMALL}, parts)
        own, others = (foreseen(blind, each, facts, parts.skills, STREAM, batch=5) for each in (drives, other))
    assert any(not np.allclose(a, b, rtol=1e-4, atol=1e-6) for a, b in zip(found, wrong, strict=True))  # it does matter who drove
    assert all(np.array_equal(a, b) for a, b in zip(own, others, strict=True))  # but not to who knows no operator


class Watching:
    """Executes every command, and asks a gate about it."""

    def __init__(self, asked: Any) -> None:
        self.asked = asked
        self.read: list[Tensor] = []

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.asked.reset(rows, seeds)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        self.read.append(self.asked.decide(latent, a_h, operator).record.g_cost)
        return Decision(a_h)


class Live:
    def __init__(self, a_h: list[Tensor], read: list[Any]) -> None:
        self.a_h, self.read = a_h, read


def run_live(task: VectorTask, assistant: Any, parts: Any, choice: Tensor, mistakes: Sequence[int]) -> Live:
    watching, numbers = Watching(assistant), range(len(choice))
    operator = operator_of(MIXTURE, choice, mistakes, OperatorContext(parts.skills.at, task.action_size, task.decision_seconds))
    layouts, draws = ([derive(f"coverage-{role}", *STREAM, i) for i in numbers] for role in ("episode", "draws"))
    loop = run_episodes(task, parts.world_model, operator, watching, layouts, draws)
    lengths = [int(loop.alive[:, row].sum()) for row in numbers]
    read = torch.stack(watching.read).numpy()
    return Live(
        [torch.from_numpy(loop.a_h[:length, row]) for row, length in enumerate(lengths)],
        [read[:length, row] for row, length in enumerate(lengths)],
    )


def costly_task(*arguments: Any, **options: Any) -> VectorTask:
    """A task whose every fifth decision costs, in every other episode of a batch."""
    task = make_task(*arguments, **options)
    inner, reset, decisions = task.step, task.reset, [0]

    def step(action: Any) -> Step:
        decisions[0] += 1
        return inner(action)._replace(cost=(np.arange(task.batch) % 2 == 0) & (decisions[0] % 5 == 0))

    def begin(seeds: Any) -> Any:
        decisions[0] = 0
        return reset(seeds)

    task.step, task.reset = step, begin  # type: ignore[method-assign]
    return task


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Tiny models with held-out episodes and episodes of a mixture, half of which cost."""
    root = tmp_path_factory.mktemp("chain")
    found = tiny_artifacts(root)
    for kind in ("heldout", "coverage"):
        found[kind] = root / kind
        found[kind].mkdir()
    HeldoutStage().run(Job("heldout", "race1", 0, HeldoutConfig(episodes=2), SETTINGS, {}, found, found["heldout"], root))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("wasp_cli.tasks.make.make_task", costly_task)
        config = CoverageConfig(operators={"noisy": (0.4,), "laggy": (0.7,), "limited-skill": (0.5,)}, episodes=10, fresh=4)
        summary = CoverageStage().run(Job("coverage", "race1", 0, config, SETTINGS, {}, found, found["coverage"], root))
    assert (summary["episodes"], summary["costly_episodes"]) == (14, 7)
    return found


def calibrated(chain: Mapping[str, Path], folder: Path, eps: float, **config: Any) -> Mapping[str, Any]:
    folder.mkdir()
    resolved = WASPConfig(**SMALL, tau_c=Coverage(coverage=eps), **config).model_dump(mode="json")
    axes = {"method": "wasp", "method_config": resolved}
    return CalibrationStage().run(Job("calibration", "race1", 0, CalibrationConfig(decisions=10), SETTINGS, axes, chain, folder, folder))


def test_a_calibration_stores_the_threshold_with_what_it_was_taken_from(chain: Mapping[str, Path], tmp_path: Path) -> None:
    summary = calibrated(chain, tmp_path / "half", 0.5)
    told = json.loads((tmp_path / "half" / "coverage.json").read_text())
    assert (told["eps"], told["n"], told["k"], told["episodes"], told["window"]) == (0.5, 5, 3, 10, 15)
    assert told["mixture"] == [["laggy", 0.7], ["noisy", 0.4]]  # no checkpoint at 0.5
    assert told["scores"] == sorted(told["scores"])
    assert told["tau_c"] == float(np.nextafter(np.float32(told["scores"][2]), np.float32(-np.inf)))
    fresh = told["fresh"]
    assert (fresh["episodes"], fresh["costly"]) == (4, 2)
    assert 0 <= fresh["low"] <= fresh["missed"] / 2 <= fresh["high"] <= 1

    assert summary["guarantee"] == told["statement"]
    assert "at most 50.0% have an onset without an alert" in told["statement"]
    assert "score 3 of 5" in told["statement"]
    thresholds = json.loads((tmp_path / "half" / "calibration.json").read_text())
    assert thresholds["tau_c"] == told["tau_c"]
    # The assistant of an evaluation reads it.
    parts = load_parts({**chain, "calibration": tmp_path / "half"}, ReturnsConfig())
    config = WASPConfig(**SMALL, tau_c=Coverage(coverage=0.5)).model_dump(mode="json")
    assistant: Any = build_assistant("wasp", config, parts)
    assert assistant.tau_c == told["tau_c"]

    # The scores are those of this assistant's own signal.
    drives, facts = load_drives(chain["coverage"])
    with torch.inference_mode():
        signals = foreseen(assistant, drives, facts, parts.skills, ("race1", 0), BATCH)
    scores = [episode_score(signal, drives.cost[drives.episode == i].numpy(), 15) for i, signal in enumerate(signals)]
    assert told["scores"] == sorted(score for score in scores[:10] if score is not None)
    assert fresh["missed"] == sum(score <= told["tau_c"] for score in scores[10:] if score is not None)


def test_a_variant_with_a_signal_of_its_own_has_a_threshold_of_its_own(chain: Mapping[str, Path], tmp_path: Path) -> None:
    full = calibrated(chain, tmp_path / "full", 0.5)
    alone = calibrated(chain, tmp_path / "alone", 0.5, variant="no-rollout")
    assert full["tau_c"] != alone["tau_c"]
    assert alone["tau_c"] == pytest.approx(json.loads((tmp_path / "alone" / "coverage.json").read_text())["tau_c"], abs=1e-4)


def test_too_few_costly_episodes_are_refused(chain: Mapping[str, Path], tmp_path: Path) -> None:
    with pytest.raises(WaspError, match=r"coverage 0\.1 needs 9 costly episodes of the operators alone, and 5 of 10 cost anything"):
        calibrated(chain, tmp_path / "tenth", 0.1)


def test_without_a_calibration_a_guaranteed_threshold_falls_back(chain: Mapping[str, Path]) -> None:
    inputs = {kind: folder for kind, folder in chain.items() if kind != "calibration"}
    config = WASPConfig(**SMALL, tau_c=Coverage()).model_dump(mode="json")
    assistant: Any = build_assistant("wasp", config, load_parts(inputs, ReturnsConfig()))
    assert assistant.tau_c == TAU_C_FALLBACK
