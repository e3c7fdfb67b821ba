"""A task without images through the command line on the smallest budgets: every stage runs, every
method acts, and what people look at afterwards is there.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.commands import wasp
from tests.vectors import NAME, SIZE, write_module
from wasp_cli.learning.shards import read_shards
from wasp_cli.notebook.world_model import load_world_model
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.tables import read_episodes

pytestmark = pytest.mark.slow

METHODS = (
    "human, ida, diffusion, csa, saferl, wasp, printed, ida-guarded, ida-least, expert, filter, "
    "reach, qcbf, mpmi, planner"
)
SPEC = f"""
name: bare
preset: smoke
task: {NAME}
methods: [{METHODS}]
operators:
  laggy: {{severe: 0.85}}
stages: [diagnostics, adversary, counterfactual]
operating_points: given
dataset: {{steps: 300}}
expert: {{interactions: 400, envs: 4, evaluation_episodes: 1}}
policies: {{labelling_episodes: 1, evaluation_episodes: 1}}
seeds: [4]
episodes: 2
wasp: {{tau_c: 0.05, tau_r: 0.0}}
printed: {{tau_c: 0.05}}
"""
CELL = f"{NAME} s4 wasp laggy=0.85"


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bare")
    write_module(folder)
    (folder / "bare.yaml").write_text(SPEC, encoding="utf-8")
    wasp(folder, "run", "bare.yaml", "-j", "2", code=0)
    return folder


def only(home: Path, kind: str) -> Path:
    (folder,) = (home / "results" / "store" / kind).iterdir()
    return folder


def test_every_stage_has_left_an_artifact(home):
    for kind in STAGES.keys() - {"clone", "operating", "severity"}:
        manifests = list((home / "results" / "store" / kind).glob("*/_manifest.json"))
        assert manifests, f"no {kind}"
        assert all(json.loads(each.read_text())["summary"] for each in manifests)


def test_every_method_has_a_cell(home):
    cells = (home / "results" / "store" / "evaluate").glob("*/episodes.parquet")
    rows = [row for path in cells for row in read_episodes([path]).to_pylist()]
    assert {row["method"] for row in rows} == set(METHODS.split(", "))


def test_the_dataset_has_vectors_and_the_model_is_taught_nothing(home):
    data = read_shards(only(home, "dataset"))
    assert data.reads == "state"
    assert data.state.shape[1] == SIZE
    np.testing.assert_array_equal(data.state, data.privileged)
    curves = json.loads((only(home, "world_model") / "curves.json").read_text())
    assert not {"teaching", "privileged"} & set(curves)
    assert (
        "final_vector_loss"
        in json.loads((only(home, "world_model") / "_manifest.json").read_text())["summary"]
    )


def test_a_loaded_model_filters_and_decodes_vectors(home):
    data = read_shards(only(home, "dataset"))
    model = load_world_model(only(home, "world_model"))
    latents = model.filter(data.state[:6], data.action[1:6])
    decoded = model.decode(latents)
    assert decoded.shape == (6, SIZE)
    assert np.isfinite(decoded).all()


def test_a_report_draws_what_the_model_imagines(home):
    wasp(home, "report", "results", code=0)
    (drawn,) = (home / "results" / "reports" / "bare" / "trained").glob("*diagnostics*")
    names = {path.name for path in drawn.iterdir()}
    assert {"open_loop.md", "open_loop.png", "reconstruction.png", "horizon.png"} <= names
    assert "Vector error" in (drawn / "open_loop.md").read_text(encoding="utf-8")


def test_an_episode_is_explained_and_replayed(home):
    assert "decision" in wasp(home, "explain", CELL, "--episode", "0", code=0).stdout
    wasp(home, "replay", CELL, "--episode", "0", "--out", "film.gif", code=0)
    wasp(home, "replay", CELL, "--episode", "0", "--step", "3", "--out", "branches.png", code=0)
    for name in ("film.gif", "branches.png"):
        with Image.open(home / name) as image:
            assert len(set(np.asarray(image.convert("L")).ravel().tolist())) > 3


def test_its_cells_are_verified_where_a_spec_names_its_module(home):
    alone = wasp(home, "verify", "results", code=2)
    assert "a module of one's own" in alone.stderr
    named = wasp(home, "verify", "results", "--spec", "bare.yaml", "--cells", "2", code=0)
    assert "2 of 2 cells are the same to the bit" in named.stdout
    elsewhere = SPEC.replace(f"task: {NAME}", "task: race1")
    (home / "elsewhere.yaml").write_text(elsewhere, encoding="utf-8")
    refused = wasp(home, "verify", "results", "--spec", "elsewhere.yaml", code=2)
    assert "the spec has no such task or method" in refused.stderr
