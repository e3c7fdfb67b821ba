"""Severities that are `auto` through the command line, on an environment in which it is known what
they come to: a reward of 1 minus the square of the command, where policies rest.

A uniform command loses a third of it and the expert nothing, so that a share of 1 - epsilon is left
of a noisy operator. To repeat a command loses nothing, so that nothing impairs a laggy one.
"""

import json
from pathlib import Path

import pytest

import wasp_cli
from tests.commands import wasp
from wasp_cli.seeds import layout_seed
from wasp_cli.store.layout import Layout
from wasp_cli.view.cells import Cells
from wasp_cli.view.site import words

pytestmark = pytest.mark.slow

MODULE = """
import gymnasium
import numpy as np


class Calm(gymnasium.Env):
    metadata = {"render_modes": [], "render_fps": 10}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1.0, 1.0, 3)
        return self.place.astype(np.float32), {}

    def step(self, action):
        self.place = 0.9 * self.place + 0.1 * np.append(action, 0.0)
        reward = 1.0 - float(np.mean(np.square(action)))
        cost = float(abs(self.place[0]) > 0.5)
        return self.place.astype(np.float32), reward, False, False, {"cost": cost}


gymnasium.register("Calm-v0", entry_point="calm:Calm", max_episode_steps=40)
"""
SPEC = """\
name: calm
preset: smoke
tasks:
  - id: calm:Calm-v0
    name: calm
    image: none
    action_repeat: 1
methods: [human, wasp, expert]
operators:
  noisy: {mild: 0.2, moderate: auto}
  laggy: {moderate: auto}
stages: [counterfactual]
operating_points: given
seeds: [0]
episodes: 2
severity: {episodes: 12}
dataset: {steps: 300}
expert: {interactions: 400, envs: 4, evaluation_episodes: 2}
wasp: {tau_r: 0.0}
"""
CELL = "calm s0 wasp noisy=auto"


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("calm")
    (folder / "calm.py").write_text(MODULE, encoding="utf-8")
    (folder / "calm.yaml").write_text(SPEC, encoding="utf-8")
    wasp(folder, "check", "calm.yaml", code=0)
    wasp(folder, "run", "calm.yaml", "-j", "2", code=0)
    return folder


@pytest.fixture(scope="module")
def chosen(home) -> dict[str, dict]:
    """What the stage says of each operator."""
    manifests = (home / "results" / "store" / "severity").glob("*/_manifest.json")
    summaries = [json.loads(path.read_text())["summary"] for path in manifests]
    return {each["operator"]: each for each in summaries if "operator" in each}


def test_the_severity_is_the_one_that_keeps_the_share(chosen):
    assert chosen["noisy"]["within"] is True
    assert chosen["noisy"]["severity"] == pytest.approx(0.4, abs=0.1)
    assert chosen["noisy"]["kept"] == pytest.approx(0.6, abs=0.1)


def test_out_of_reach_is_the_worst_severity_and_told(home, chosen):
    assert (chosen["laggy"]["within"], chosen["laggy"]["severity"]) == (False, 1.0)
    assert "out of its reach" in wasp(home, "status", "results", code=0).stdout
    foot = wasp(home, "report", "results", code=0).stdout
    assert "laggy keeps" in foot
    assert f"noisy drives at {chosen['noisy']['severity']:.3g} (auto)" in foot


def test_rows_have_the_number_and_another_one_stays_as_it_is(home, chosen):
    results = wasp_cli.results(home / "results")
    rows = results.episodes(operator="noisy").to_pylist()
    moderate = {row["value"] for row in rows if row["severity"] == "moderate"}
    assert moderate == {chosen["noisy"]["severity"]}
    assert {row["value"] for row in rows if row["severity"] == "mild"} == {0.2}
    assert {row["method"] for row in rows} == {"human", "wasp"}
    assert not results.missing
    assert results.branches(operator="laggy").num_rows >= 0


def test_held_out_worlds_are_not_those_of_the_cells(home):
    rows = wasp_cli.results(home / "results").episodes().to_pylist()
    evaluated = {row["episode_seed"] for row in rows}
    assert evaluated == {layout_seed("calm", 0, episode) for episode in range(2)}


def test_a_second_run_computes_nothing_and_the_plan_names_the_severities(home, chosen):
    plan = wasp(home, "plan", "calm.yaml", code=0).stdout
    assert "nothing to run" in plan
    assert f"calm s0 severity noisy: {chosen['noisy']['severity']:g}" in plan
    assert "0 computed" in wasp(home, "run", "calm.yaml", code=0).stderr


def test_another_share_computes_the_search_and_what_reads_it(home):
    asked = ["plan", "calm.yaml", "--set", "severity.kept=0.5", "--json"]
    nodes = json.loads(wasp(home, *asked, code=0).stdout)["nodes"]
    again = {node["label"] for node in nodes if node["state"] not in ("cached", "unneeded")}
    assert "calm s0 severity noisy" in again
    assert CELL in again
    assert "calm s0 wasp noisy=0.2" not in again
    assert "calm s0 policies" not in again


def test_a_cell_is_explained_shown_and_replayed(home, chosen):
    explained = wasp(home, "explain", CELL, "--episode", "0", code=0).stdout
    severity = f"{chosen['noisy']['severity']:g}"
    assert f"noisy {severity}" in explained
    assert "chosen on held-out worlds" in explained
    as_reported = f"calm wasp noisy={severity} seed 0"
    assert wasp(home, "explain", as_reported, "--episode", "0", code=0).stdout == explained
    wasp(home, "replay", CELL, "--episode", "0", "--out", "film.gif", code=0)
    wasp(home, "replay", CELL, "--episode", "1", "--step", "3", "--out", "both.png", code=0)
    assert severity in wasp(home, "show", "calm s0 severity noisy", code=0).stdout


def test_an_assistant_of_the_cell_is_found_by_both_names(home, chosen):
    for name in (CELL, f"calm s0 wasp noisy={chosen['noisy']['severity']:g}"):
        assert wasp_cli.load_assistant(home / "results", name).method == "wasp"


def test_the_pages_of_the_results_have_the_number(home, chosen):
    cells = Cells(Layout(home / "results"))
    listed = next(cell for cell in cells.listed() if cell.label == CELL)
    assert words(listed)[3] == f"{chosen['noisy']['severity']:g} (moderate)"
    assert cells.read([listed]).cell(listed.key) is not None


def test_more_episodes_take_over_the_rows_that_are_there(home, chosen):
    before = wasp_cli.results(home / "results").episodes(operator="laggy", method="human")
    settings = ["--set", "episodes=4", "--set", "side_by_side=2"]
    wasp(home, "run", "calm.yaml", "--set", "side_by_side=2", "-m", "human", code=0)
    plan = wasp(home, "plan", "calm.yaml", *settings, "-m", "human", code=0).stdout
    assert "are taken over" in plan
    wasp(home, "run", "calm.yaml", *settings, "-m", "human", code=0)
    after = wasp_cli.results(home / "results").episodes(operator="laggy", method="human")
    assert after.num_rows == 4
    assert after["episode_seed"].to_pylist()[:2] == before["episode_seed"].to_pylist()
    assert set(after["value"].to_pylist()) == {chosen["laggy"]["severity"]}


def test_a_strict_run_stops_at_what_is_out_of_reach(home):
    done = wasp(home, "run", "calm.yaml", "--strict", "--select", "operator=laggy")
    assert done.returncode == 1
