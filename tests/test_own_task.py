"""The example of docs/own_task.md, as a user runs it: a module and a spec in a folder, and
`wasp run`.
"""

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.commands import ROOT, wasp
from wasp_cli.store.branches import read_branches
from wasp_cli.store.tables import read_episodes

EXAMPLES = ROOT / "docs" / "examples"
SETTINGS = (
    "preset=smoke",
    "episodes=2",
    "expert.interactions=400",
    "expert.envs=4",
    "expert.evaluation_episodes=2",
    "dataset.steps=300",
    "policies.evaluation_episodes=2",
    "policies.reinforce.interactions=0",
)
SMALL = [part for setting in SETTINGS for part in ("--set", setting)]
"""One round and few episodes: every stage runs, and nothing is learned."""


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """A folder with the module, the spec, and the results of its run on the smallest budgets."""
    folder = tmp_path_factory.mktemp("own")
    for name in ("puddle.py", "puddle.yaml"):
        shutil.copy(EXAMPLES / name, folder)
    done = wasp(
        folder,
        "run",
        "puddle.yaml",
        "-j",
        "2",
        *SMALL,
        "--set",
        "stages=[diagnostics, counterfactual]",
        code=0,
    )
    (folder / "printed.txt").write_text(done.stdout, encoding="utf-8")
    return folder


@pytest.mark.slow
def test_a_run_prints_the_tables_of_ones_own_task(home):
    printed = (home / "printed.txt").read_text(encoding="utf-8")
    for word in ("Puddle-v0", "Human-only", "WASP", "Expert"):
        assert word in printed
    assert (home / "results" / "reports" / "puddle" / "cost_return.png").is_file()


@pytest.mark.slow
def test_its_snapshots_serve_to_judge_interventions(home):
    found = [
        read_branches(path)
        for path in (home / "results" / "store" / "counterfactual").glob("*/branches.parquet")
    ]
    assert {branches.cell.identity.method for branches in found} == {"wasp"}
    assert sum(len(branches.t) for branches in found) > 0
    assert "Were the interventions necessary?" in (home / "printed.txt").read_text(encoding="utf-8")


@pytest.mark.slow
def test_its_costs_and_episodes_are_its_own(home):
    cells = [
        read_episodes([path]).to_pylist()
        for path in (home / "results" / "store" / "evaluate").glob("*/episodes.parquet")
    ]
    assert len(cells) == 5
    rows = [row for cell in cells for row in cell]
    assert {row["task"] for row in rows} == {"puddle:Puddle-v0"}
    assert len(rows) == 10
    # Ten untrained episodes may well miss the puddle; the data also has random drivers.
    (contents,) = (home / "results" / "store" / "dataset").glob("*/contents.json")
    assert json.loads(contents.read_text())["all"]["costly_share"] > 0
    assert all(0 < row["env_steps"] <= 200 for row in rows)
    assert len({row["return"] for row in rows}) > 5


@pytest.mark.slow
def test_a_second_run_computes_nothing_and_a_changed_environment_runs_again(home):
    assert "0 computed, 16 computed before" in wasp(home, "run", "puddle.yaml", *SMALL).stderr
    module = home / "puddle.py"
    text = module.read_text(encoding="utf-8")
    module.write_text(
        text.replace("WET, REACHED, STEP = 0.3", "WET, REACHED, STEP = 0.35"), encoding="utf-8"
    )
    try:
        planned = wasp(home, "plan", "puddle.yaml", *SMALL)
    finally:
        module.write_text(text, encoding="utf-8")
    assert re.search(r"total +16 +0 +0 +16", planned.stdout), planned.stdout
    assert "puddle:Puddle-v0 s0 expert and 15 more: code changed: puddle\n" in planned.stdout
