"""`wasp bench planner`, on models of smoke size."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import run_here
from wasp_cli.spec import derived
from wasp_cli.studies.planner_timing import TABLE1, matrix_rate

ROOT = Path(__file__).parents[2]
KINDS = ["quiet", "task", "safety"]
SMALLER = {"candidates": 48, "elites": 16, "iterations": 4, "feasible": 16}
"""12 times the rows of the planner of smoke size, and a ninth of the paper's."""


@pytest.fixture
def smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    """A planner below the sizes of the paper, which take seconds."""
    monkeypatch.setattr(derived, "PAPER", SMALLER)


def invoke(*arguments: str) -> str:
    outcome = run_here("bench", "planner", *arguments, columns=120)
    assert outcome.exit_code == 0, outcome.output
    return outcome.output


def test_every_kind_of_decision_is_timed_under_both_planners(smaller: None) -> None:
    paper, smoke = timed_under_both_planners()
    assert paper["safety"] > 5 * smoke["safety"]


@pytest.mark.slow
def test_every_kind_of_decision_is_timed_under_the_papers_planner() -> None:
    # 300 candidates in 6 iterations against 8 in 2 are 112.5 times the rows of the search.
    paper, smoke = timed_under_both_planners()
    assert paper["safety"] > 20 * smoke["safety"]


def timed_under_both_planners() -> list[dict[str, float]]:
    """Time both; return the GFLOP of every kind of decision, of the larger planner and of the smaller one."""
    found = json.loads(invoke("specs/smoke.yaml", "--threads", "1", "--repeats", "2", "--json"))
    assert list(found) == ["paper", "smoke"]
    for bench in found.values():
        timings = {timing["kind"]: timing for timing in bench["timings"]}
        assert list(timings) == KINDS
        assert all(0 < timing["ms"] <= timing["ms_p50"] for timing in timings.values())
        # What the task gate asks for is imagined before it fires; the safety gate asks for a search.
        assert timings["quiet"]["gflop"] == timings["task"]["gflop"] < timings["safety"]["gflop"]
        for timing in timings.values():
            assert timing["ratio"] == pytest.approx(timing["ms"] / 1000 * bench["roof"] / timing["gflop"])
        assert sum(bench["shares"].values()) == pytest.approx(1.0)
        assert "addmm" in bench["shares"]
    # Both planners gate alike.
    paper, smoke = ({timing["kind"]: timing["gflop"] for timing in found[name]["timings"]} for name in found)
    assert paper["quiet"] == smoke["quiet"]
    return [paper, smoke]


@pytest.mark.slow
def test_the_table_says_what_is_timed_and_the_mean_decision(smaller: None) -> None:
    text = invoke("specs/smoke.yaml", "--threads", "1", "--repeats", "1", "--batch", "2")
    assert "2 episodes side by side, 1 thread" in text
    assert all(kind in text for kind in KINDS)
    assert all(f"mean decision at Int. {rate:.2f} ({task})" in text for task, rate in TABLE1.items())


@pytest.mark.slow
def test_the_profiler_writes_nothing_between_the_numbers() -> None:
    """In a process of its own: torch reads the variable once."""
    program = f"""
from wasp_cli.cli.app import app
from wasp_cli.spec import derived

derived.PAPER = {SMALLER}
app(["bench", "planner", "specs/smoke.yaml", "--threads", "1", "--repeats", "1", "--json"])
"""
    here = {name: value for name, value in os.environ.items() if name != "KINETO_LOG_LEVEL"}
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=300, check=True, env=here)
    assert "profiler" not in done.stderr
    assert "USDT" not in done.stderr
    assert json.loads(done.stdout)


def test_a_setting_without_a_spec_is_refused() -> None:
    outcome = run_here("bench", "planner", "--set", "wasp.candidates=64", columns=120)
    assert outcome.exit_code == 2
    assert "--set needs a spec to change" in outcome.output


def test_the_roof_is_the_fastest_of_its_shapes() -> None:
    assert matrix_rate(((64, 64, 64),), repeats=3) > 0
