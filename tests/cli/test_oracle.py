"""`wasp bench oracle`, with an untrained expert: what it prints, and what it says to wrong input."""

from __future__ import annotations

import itertools
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import Result

from tests.commands import run_here
from wasp_cli.errors import TaskError
from wasp_cli.models.policy import PrivilegedPolicy, checkpoint_name, save_privileged
from wasp_cli.plan.grid import lay_out
from wasp_cli.seeds import layout_seed, operator_seed
from wasp_cli.spec.load import load
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.studies import oracle
from wasp_cli.tasks.make import make_task

SPEC = """\
name: little
preset: smoke
tasks: [goal0, goal1]
methods: [human, wasp]
variants: [full, safety-only]
operators:
  laggy: {moderate: 0.7}
seeds: [3, 4]
training_seed: 5
action_repeat: 20
wasp: {horizon: 1, residual_steps: 1, candidates: 5, elites: 2, feasible: 2, iterations: 1}
"""


def invoke(*arguments: str | Path) -> Result:
    return run_here("bench", "oracle", *arguments, columns=160)


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    path = tmp_path / "spec file.yaml"
    path.write_text(SPEC, encoding="utf-8")
    return path


@pytest.fixture
def results(spec: Path, tmp_path: Path) -> Path:
    """A results folder with an untrained expert of goal1."""
    layout = Layout(tmp_path / "results")
    node = next(node for node in lay_out(load(spec).spec).nodes if (node.kind, node.task) == ("expert", "goal1"))
    assert node.seed == 5
    task = make_task("goal1", 1, observe=())
    folder = staging_folder(layout, node.key)
    torch.manual_seed(0)
    save_privileged(PrivilegedPolicy(task.privileged_size, [8], 2), folder / checkpoint_name(1.0), task.privileged_size, (8,), 2)
    commit(layout, "expert", node.key, folder, {})
    return layout.root


def test_every_assistant_drives_the_same_episodes(spec: Path, results: Path) -> None:
    before = sorted(results.rglob("*"))
    arguments = ("--task", "goal1", "--operator", "laggy=0.7", "--episodes", "2", "--threads", "1", "--results", results)
    done = invoke(spec, *arguments, "--tau-r", "0", "--variant", "full", "--variant", "safety-only", "--json")
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert (record["task"], record["operator"], record["value"], record["seed"], record["tau_r"]) == ("goal1", "laggy", 0.7, 3, 0.0)
    human, full, safety = record["rows"]
    assert [(row["method"], row["variant"]) for row in record["rows"]] == [("human", None), ("wasp", "full"), ("wasp", "safety-only")]
    assert all(len(row["episodes"]) == 2 for row in record["rows"])
    assert [episode["decisions"] for episode in human["episodes"]] == [50, 50]
    assert (human["int_rate"], human["safety_gate"], human["task_gate"]) == (0, 0, 0)
    assert full["task_gate"] > 0
    assert safety["task_gate"] == 0
    assert human["return"] == pytest.approx(sum(episode["return"] for episode in human["episodes"]) / 2)
    assert sorted(results.rglob("*")) == before

    table = invoke(spec, *arguments, "--episodes", "1")
    assert table.exit_code == 0, table.output
    assert "Oracle dynamics: Goal1, Laggy 0.7, seed 3, 1 episode\n" in table.output
    assert re.search(r"^ Human-only +-?\d+\.\d\d ", table.output, re.MULTILINE)
    assert re.search(r"^ WASP +-?\d+\.\d\d \([+-]\d+\.\d\d\) ", table.output, re.MULTILINE)
    assert "time: Human-only" in table.output


def test_the_worlds_are_those_of_the_evaluation(spec: Path, results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def caught(*arguments: Any, **options: Any) -> None:
        seen.append(arguments)
        raise TaskError("enough")

    monkeypatch.setattr(oracle, "run_episodes", caught)
    done = invoke(spec, "--task", "goal1", "--operator", "laggy=0.7", "--episodes", "11", "--results", results)
    assert (done.exit_code, "enough" in done.output) == (1, True), done.output
    task, _, operator, _, layouts, methods = seen[0]
    assert (task.batch, operator.batch) == (8, 8)
    assert layouts == [layout_seed("goal1", 3, e) for e in range(8)]
    assert operator.noise.seeds == [operator_seed("goal1", "laggy", 3, e) for e in range(8)]
    assert not {*methods} & {*operator.noise.seeds}  # imagination has a stream of its own


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--operator", "lagy=0.7"], "did you mean 'laggy'?"),
        (["--operator", "laggy"], "'laggy' has no severity"),
        (["--operator", "laggy=much"], "'laggy=much' has no severity"),
        (["--operator", "laggy=nan"], "lies between 0 and 1"),
        (["--operator", "laggy=1.5"], "lies between 0 and 1"),
        (["--operator", "limited-skill=0.3"], "checkpoints: 0.1, 0.25, 0.5, 1"),
        (["--operator", "laggy=0.7", "--task", "goal2"], "unknown task of this spec 'goal2'"),
        (["--operator", "laggy=0.7", "--variant", "no-rollout"], "without critics 'no-rollout'"),
        (["--operator", "laggy=0.7", "--variant", "ful"], "did you mean 'full'?"),
    ],
)
def test_wrong_names_and_numbers_are_usage_errors(spec: Path, arguments: list[str], message: str) -> None:
    done = invoke(spec, "--task", "goal1", *arguments)
    assert (done.exit_code, message in " ".join(done.output.split())) == (2, True), done.output


def test_a_spec_of_several_tasks_asks_which(spec: Path) -> None:
    done = invoke(spec, "--operator", "laggy=0.7")
    assert (done.exit_code, "name one with --task" in done.output) == (2, True), done.output


def test_without_an_expert_it_says_which_run_trains_one(spec: Path, tmp_path: Path) -> None:
    done = invoke(spec, "--task", "goal1", "--operator", "laggy=0.7", "--results", tmp_path / "none", "--set", "expert.interactions=900")
    assert done.exit_code == 1
    assert "no goal1 s5 expert" in done.output
    assert not (tmp_path / "none").exists()
    command = shlex.split(next(line for line in done.output.splitlines() if "wasp run" in line))
    assert command[:2] == ["wasp", "run"]
    settings = [value for option, value in itertools.pairwise(command) if option == "--set"]
    nodes = lay_out(load(Path(command[2]), settings).spec.model_copy(update={"tasks": ("goal1",)})).nodes
    assert [(node.kind, node.seed, node.config["interactions"]) for node in nodes] == [("expert", 5, 900)]


def test_a_damaged_expert_is_not_used(spec: Path, results: Path) -> None:
    next(results.rglob(checkpoint_name(1.0))).write_bytes(b"")
    done = invoke(spec, "--task", "goal1", "--operator", "laggy=0.7", "--results", results)
    assert (done.exit_code, "has 0 bytes" in done.output) == (1, True), done.output


def test_the_earlier_name_goes_on_and_is_not_shown() -> None:
    assert "ceiling" not in run_here("bench", "--help", columns=100).output
    assert "oracle dynamics" in run_here("bench", "ceiling", "--help", columns=100).output
