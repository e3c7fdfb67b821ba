"""Stages on a task whose operators know more than assistants perceive, with tiny untrained
models.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.artifacts import tiny_artifacts, tiny_expert
from tests.cells import REPEAT, SETTINGS, Evaluated, evaluated
from wasp_cli.errors import ArtifactError
from wasp_cli.learning.clone import Issued, fit_clone
from wasp_cli.learning.configs import CloneConfig, CounterfactualConfig, HeldoutConfig
from wasp_cli.learning.configs.baselines import ResidualConfig
from wasp_cli.learning.rerun import Recorded, Rerun
from wasp_cli.methods.registry import METHODS
from wasp_cli.models.clone import Clone
from wasp_cli.models.world_model import load_world_model
from wasp_cli.operators.base import EpisodeNoise, OperatorContext, build_operator
from wasp_cli.plan.grid import OPERATOR_CLONE, lay_out, stage_class
from wasp_cli.spec.load import load
from wasp_cli.spec.model import validate
from wasp_cli.stages.base import Job, no_progress
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.recorded import read_recorded
from wasp_cli.tasks.make import make_task
from wasp_cli.video.trace import Source

TASK = "goal1-two"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("artifacts")
    size = make_task(TASK, 1, observe=()).privileged_size
    found = tiny_artifacts(root) | {
        "expert": tiny_expert(root / "expert", size),
        "heldout": root / "heldout",
    }
    judged = {"1": {"latent": {"return": 1.0}, "privileged": {"return": 2.0}}}
    (found["policies"] / "evaluation.json").write_text(json.dumps({"skills": judged}))
    found["heldout"].mkdir()
    job = Job(
        "heldout",
        TASK,
        0,
        HeldoutConfig(episodes=2),
        SETTINGS,
        {},
        found,
        found["heldout"],
        found["heldout"],
    )
    stage_class("heldout")().run(job)
    return found


@pytest.fixture(scope="module")
def cell(inputs, tmp_path_factory) -> Evaluated:
    return evaluated(inputs, tmp_path_factory.mktemp("cell"), "saferl", {}, "laggy", 0.5, task=TASK)


def source_of(cell: Evaluated, expert: Path | None) -> Source:
    recorded = Recorded(**read_recorded(cell.path))
    models = cell.inputs["world_model"], cell.inputs["policies"]
    return Source(
        TASK, REPEAT, cell.seed, cell.variant, cell.value, recorded, *models, expert=expert
    )


def again(cell: Evaluated, expert: Path | None) -> Rerun:
    source = source_of(cell, expert)
    world = source.world()
    return Rerun(
        world, load_world_model(source.world_model), source.operator_in(world), source.recorded
    )


def test_a_cell_comes_back_with_operators_who_know_and_with_no_others(cell):
    assert sum(1 for _ in again(cell, cell.inputs["expert"])) == 1000 // REPEAT
    with pytest.raises(ArtifactError, match="the command of the operator"):
        list(again(cell, None))


@pytest.mark.parametrize(
    "method",
    ["ida", *(pytest.param(name, marks=pytest.mark.slow) for name in ("diffusion", "wasp"))],
)
def test_cells_are_evaluated_and_branched(method, inputs, tmp_path):
    small = {
        "wasp": {"candidates": 4, "elites": 2, "feasible": 2, "iterations": 1, "rollouts": 1},
        "ida": {"vote": 0.0},
    }
    config = METHODS[method].config_model()(**small.get(method, {})).model_dump(mode="json")
    done = evaluated(inputs, tmp_path / "cell", method, config, "noisy", 0.4, task=TASK, episodes=2)
    axes = {"method": method, "method_config": config, "operator": "noisy", "value": 0.4}
    folder, read = tmp_path / "branches", {**inputs, "evaluate": done.path.parent}
    folder.mkdir()
    job = Job(
        "counterfactual",
        TASK,
        0,
        CounterfactualConfig(window=3, most=4),
        SETTINGS,
        axes,
        read,
        folder,
        folder,
    )
    summary = stage_class("counterfactual")().run(job)
    assert len(read_branches(folder / BRANCHES_FILE).t) == summary["branched"]
    assert summary["branched"] > 0 or summary["interventions"] == 0


def test_the_residual_is_trained_behind_operators_who_know(inputs, tmp_path):
    operators = {"laggy": (0.5,), "limited-skill": (0.25,)}
    config = ResidualConfig(
        interactions=64, envs=2, rollout=16, batch=16, hidden=(8,), operators=operators
    )
    job = Job("residual", TASK, 0, config, SETTINGS, {}, inputs, tmp_path, tmp_path)
    summary = stage_class("residual")().run(job)
    assert summary["interactions"] == 64
    assert (tmp_path / "residual.safetensors").exists()


def test_what_drives_there_reads_the_expert_and_elsewhere_does_not(tmp_path):
    """And the keys of another task are those that it has without this one."""
    path = tmp_path / "both.yaml"
    text = (
        "name: both\npreset: smoke\ntasks: [TASKS]\nmethods: [human, saferl, "
        "wasp]\noperators: {laggy: {moderate: 0.7}}\n"
        "stages: [counterfactual]\nseeds: [0]\n"
    )
    path.write_text(text.replace("TASKS", f"goal1, {TASK}"))
    grid = lay_out(load(path).spec)
    reading = {
        task: {node.kind for node in grid.nodes if node.task == task and "expert" in node.needs}
        for task in ("goal1", TASK)
    }
    assert reading["goal1"] == {"dataset", "policies"}
    assert reading[TASK] - reading["goal1"] == {"heldout", "residual", "evaluate", "counterfactual"}
    path.write_text(text.replace("TASKS", "goal1"))
    assert {node.key for node in lay_out(load(path).spec).nodes} == {
        node.key for node in grid.nodes if node.task == "goal1"
    }


# Clones of operators: densities, what is learned of a rule that is known, and where a plan has one.


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
    ("variant", "value", "ways"),
    [
        ("laggy", 0.7, [0.7, 0.3, 0.0]),
        ("noisy", 0.4, [0.0, 0.6, 0.4]),
        ("laggy", 0.0, [0.0, 1.0, 0.0]),
    ],
)
def test_it_learns_how_often_an_operator_repeats_and_slips(variant, value, ways):
    clone = learned(driven(variant, value))
    assert clone.weight_logits.softmax(-1).tolist() == pytest.approx(ways, abs=0.05)
    assert clone.spread.max() < 0.1


def test_it_learns_what_an_operator_intends_where_that_is_not_the_expert_s():
    seen = driven("laggy", 0.0)
    own = (0.8 * seen.features[:, 1:] - 0.2).clamp(-1, 1)
    clone = learned(seen._replace(command=own), updates=900)
    error = (clone.intended(seen.features, seen.last, expert(seen.features)) - own).square().mean()
    assert error < 0.1 * (expert(seen.features) - own).square().mean()


def test_densities_integrate_to_one_within_the_bounds_and_draws_follow_them():
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
    assert float(((drawn + 0.2).abs() < 0.3).float().mean()) == pytest.approx(
        0.5 + 0.1 * 0.3, abs=0.02
    )
    assert float(clone.mean(*one)) == pytest.approx(float(drawn.mean()), abs=0.02)


def test_where_a_person_s_clone_drives_it_is_read_and_what_fits_it_is_in_its_key():
    clones = {"cloned": {"p7": 7}}
    grid = lay_out(
        validate(
            {
                "name": "x",
                "preset": "smoke",
                "tasks": ["goal1"],
                "methods": ["human"],
                "seeds": [0],
                "operators": clones,
            }
        )
    )
    ((_, evaluation),) = grid.cells
    node = evaluation.needs[OPERATOR_CLONE]
    assert (node.kind, node.axes["operator"], node.axes["value"]) == ("clone", "person", 7)
    assert "wasp_cli.learning.clone" in node.modules
