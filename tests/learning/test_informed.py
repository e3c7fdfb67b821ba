"""Stages on a task whose operators know more than assistants perceive, with tiny untrained models."""

import json
from pathlib import Path

import pytest

from tests.artifacts import tiny_artifacts, tiny_expert
from tests.cells import REPEAT, SETTINGS, Evaluated, evaluated
from wasp_cli.errors import ArtifactError
from wasp_cli.learning.configs import CounterfactualConfig, HeldoutConfig
from wasp_cli.learning.configs.baselines import ResidualConfig
from wasp_cli.learning.rerun import Recorded, Rerun
from wasp_cli.methods.registry import METHODS
from wasp_cli.models.world_model import load_world_model
from wasp_cli.plan.grid import lay_out, stage_class
from wasp_cli.spec.load import load
from wasp_cli.stages.base import Job
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.recorded import read_recorded
from wasp_cli.tasks.make import make_task
from wasp_cli.video.trace import Source

TASK = "goal1-two"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("artifacts")
    size = make_task(TASK, 1, observe=()).privileged_size
    found = tiny_artifacts(root) | {"expert": tiny_expert(root / "expert", size), "heldout": root / "heldout"}
    judged = {"1": {"latent": {"return": 1.0}, "privileged": {"return": 2.0}}}
    (found["policies"] / "evaluation.json").write_text(json.dumps({"skills": judged}))
    found["heldout"].mkdir()
    job = Job("heldout", TASK, 0, HeldoutConfig(episodes=2), SETTINGS, {}, found, found["heldout"], found["heldout"])
    stage_class("heldout")().run(job)
    return found


@pytest.fixture(scope="module")
def cell(inputs, tmp_path_factory) -> Evaluated:
    return evaluated(inputs, tmp_path_factory.mktemp("cell"), "saferl", {}, "laggy", 0.5, task=TASK)


def source_of(cell: Evaluated, expert: Path | None) -> Source:
    recorded = Recorded(**read_recorded(cell.path))
    models = cell.inputs["world_model"], cell.inputs["policies"]
    return Source(TASK, REPEAT, cell.seed, cell.variant, cell.value, recorded, *models, expert=expert)


def again(cell: Evaluated, expert: Path | None) -> Rerun:
    source = source_of(cell, expert)
    world = source.world()
    return Rerun(world, load_world_model(source.world_model), source.operator_in(world), source.recorded)


def test_a_cell_comes_back_with_operators_who_know_and_with_no_others(cell):
    assert sum(1 for _ in again(cell, cell.inputs["expert"])) == 1000 // REPEAT
    with pytest.raises(ArtifactError, match="the command of the operator"):
        list(again(cell, None))


@pytest.mark.parametrize("method", ["ida", *(pytest.param(name, marks=pytest.mark.slow) for name in ("diffusion", "wasp"))])
def test_cells_are_evaluated_and_branched(method, inputs, tmp_path):
    small = {"wasp": {"candidates": 4, "elites": 2, "feasible": 2, "iterations": 1, "rollouts": 1}, "ida": {"vote": 0.0}}
    config = METHODS[method].config_model()(**small.get(method, {})).model_dump(mode="json")
    done = evaluated(inputs, tmp_path / "cell", method, config, "noisy", 0.4, task=TASK, episodes=2)
    axes = {"method": method, "method_config": config, "operator": "noisy", "value": 0.4}
    folder, read = tmp_path / "branches", {**inputs, "evaluate": done.path.parent}
    folder.mkdir()
    job = Job("counterfactual", TASK, 0, CounterfactualConfig(window=3, most=4), SETTINGS, axes, read, folder, folder)
    summary = stage_class("counterfactual")().run(job)
    assert len(read_branches(folder / BRANCHES_FILE).t) == summary["branched"]
    assert summary["branched"] > 0 or summary["interventions"] == 0


def test_the_residual_is_trained_behind_operators_who_know(inputs, tmp_path):
    operators = {"laggy": (0.5,), "limited-skill": (0.25,)}
    config = ResidualConfig(interactions=64, envs=2, rollout=16, batch=16, hidden=(8,), operators=operators)
    job = Job("residual", TASK, 0, config, SETTINGS, {}, inputs, tmp_path, tmp_path)
    summary = stage_class("residual")().run(job)
    assert summary["interactions"] == 64
    assert (tmp_path / "residual.safetensors").exists()


def test_what_drives_there_reads_the_expert_and_elsewhere_does_not(tmp_path):
    """And the keys of another task are those that it has without this one."""
    path = tmp_path / "both.yaml"
    text = (
        "name: both\npreset: smoke\ntasks: [TASKS]\nmethods: [human, saferl, wasp]\noperators: {laggy: {moderate: 0.7}}\n"
        "stages: [counterfactual]\nseeds: [0]\n"
    )
    path.write_text(text.replace("TASKS", f"goal1, {TASK}"))
    grid = lay_out(load(path).spec)
    reading = {task: {node.kind for node in grid.nodes if node.task == task and "expert" in node.needs} for task in ("goal1", TASK)}
    assert reading["goal1"] == {"dataset", "policies"}
    assert reading[TASK] - reading["goal1"] == {"heldout", "residual", "evaluate", "counterfactual"}
    path.write_text(text.replace("TASKS", "goal1"))
    assert {node.key for node in lay_out(load(path).spec).nodes} == {node.key for node in grid.nodes if node.task == "goal1"}
