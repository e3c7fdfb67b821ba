"""What orchestration costs beside the work that it orchestrates. Limits are compared as ratios
to what was measured in the same run.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tests.plan.test_reasons import store
from tests.run.harness import ROOT, Fakes, fakes, prepared
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.run.pools.base import Pool
from wasp_cli.run.pools.local import LokyPool
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner
from wasp_cli.spec.model import Spec, validate
from wasp_cli.store.layout import Layout

__all__ = ["fakes"]

LARGE = 28  # seeds of a grid of 5,040 cells


def document_of(seeds: int) -> dict[str, Any]:
    """Training once, and three cells for each seed."""
    operators = {"noisy": {"mild": 0.2, "moderate": 0.4, "severe": 0.6}}
    return {
        "name": "many",
        "preset": "smoke",
        "tasks": ["goal1"],
        "methods": ["human"],
        "operators": operators,
        "seeds": list(range(seeds)),
        "training_seed": 0,
        "stages": [],
    }


def large() -> Spec:
    operators = {
        "noisy": {"a": 0.2, "b": 0.4, "c": 0.6},
        "laggy": {"a": 0.5, "b": 0.7, "c": 0.85},
        "limited-skill": {"a": 0.5, "b": 0.25, "c": 0.1},
        "reaction-time": {"a": 0.16, "b": 0.24, "c": 0.4},
    }
    tasks, methods = ["race1", "formula1", "goal1"], ["human", "ida", "diffusion", "saferl", "wasp"]
    seeds = list(range(LARGE))
    return validate(
        {
            "name": "large",
            "tasks": tasks,
            "methods": methods,
            "operators": operators,
            "seeds": seeds,
            "training_seed": 0,
        }
    )


def cells_alone(seeds: int, tmp_path: Path, name: str) -> tuple[Layout, Plan, str]:
    """A store in which only cells are left to compute, all of them independent."""
    spec = tmp_path / f"{name}.yaml"
    spec.write_text(json.dumps(document_of(seeds)), encoding="utf-8")
    loaded, layout, plan = prepared(spec, tmp_path / name)
    for node in plan.to_run():
        if node.kind != "evaluate":
            store(layout, node)
    loaded, layout, plan = prepared(spec, tmp_path / name)
    assert {node.kind for node in plan.to_run()} == {"evaluate"}
    return layout, plan, new_run(layout, loaded, plan)


def carried_out(layout: Layout, plan: Plan, run_id: str, pool: Pool) -> float:
    begun = time.perf_counter()
    assert Runner(layout, run_id, pool).run(plan).complete
    return time.perf_counter() - begun


def warmed(jobs: int, tmp_path: Path, fakes: Fakes, **behaviour: float) -> LokyPool:
    """Workers that have imported what they need, which they do once in a run; their stages
    behave as they are told now.
    """
    fakes.set(**behaviour)
    pool = LokyPool(jobs)
    carried_out(*cells_alone(1, tmp_path, f"warm{jobs}"), pool)
    return pool


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_cell_costs_less_than_ten_milliseconds(benchmark, jobs, fakes, tmp_path):
    """Cells that do nothing: what is left is lock, log, heartbeat, staging, manifest, fsync,
    rename, journal.
    """
    pool = warmed(jobs, tmp_path, fakes)
    layout, plan, run_id = cells_alone(200, tmp_path, "many")
    cells = len(plan.to_run())
    benchmark.pedantic(carried_out, (layout, plan, run_id, pool), rounds=1)
    pool.close(kill=True)
    benchmark.extra_info["ms_a_cell"] = 1000 * benchmark.stats.stats.min / cells
    assert benchmark.extra_info["ms_a_cell"] < 10


def test_orchestration_is_under_one_percent_of_a_grid(benchmark, fakes, tmp_path):
    """Cells of a second each, two at a time, beside the time that they themselves take."""
    pool = warmed(2, tmp_path, fakes, seconds=1.0)
    layout, plan, run_id = cells_alone(20, tmp_path, "grid")
    benchmark.pedantic(carried_out, (layout, plan, run_id, pool), rounds=1)
    pool.close(kill=True)
    own = len(plan.to_run()) * 1.0 / 2
    benchmark.extra_info["share_beside_the_work"] = benchmark.stats.stats.min / own - 1
    assert benchmark.extra_info["share_beside_the_work"] < 0.01


GRID = """
name: grid
preset: smoke
tasks: [goal1, race1]
methods: [human, ida, wasp, expert]
operators: {noisy: {mild: 0.2}, laggy: {moderate: 0.7}}
seeds: [0]
"""


def test_a_grid_of_two_tasks_takes_little_more_than_half_of_its_time_on_one_worker(
    benchmark, fakes, tmp_path
):
    """Chains of nodes that each keep a core busy for a third of a second, in the order of a
    real grid; beside them, two bare processes.
    """
    spec = tmp_path / "grid.yaml"
    spec.write_text(GRID, encoding="utf-8")
    times, shares = {}, {}
    for jobs in (1, 2):
        pool = warmed(jobs, tmp_path, fakes, work=WORK)
        loaded, layout, plan = prepared(spec, tmp_path / f"grid{jobs}")
        runner = Runner(layout, new_run(layout, loaded, plan), pool)
        summary = (
            runner.run(plan) if jobs == 1 else benchmark.pedantic(runner.run, (plan,), rounds=1)
        )
        assert summary.complete
        times[jobs], shares[jobs] = summary.seconds, summary.busy_share
        pool.close(kill=True)
    benchmark.extra_info["of_one_worker"] = times[2] / times[1]
    benchmark.extra_info["of_one_bare_process"] = bare(2) / bare(1)
    benchmark.extra_info["busy_share"] = shares[2]
    assert benchmark.extra_info["of_one_worker"] < 0.55 + max(
        0.0, benchmark.extra_info["of_one_bare_process"] - 0.5
    )
    assert benchmark.extra_info["busy_share"] > 0.92


WORK = 1_200_000  # iterations of a hash: about a third of a second


def bare(processes: int, pieces: int = 60) -> float:
    """Seconds that bare processes need for so many pieces of the same work."""
    command = (
        f"import hashlib\nfor _ in range({pieces // processes}): hashlib.pbkdf2_hmac('sha256', "
        f"b'', b'', {WORK})"
    )
    begun = time.perf_counter()
    for process in [subprocess.Popen([sys.executable, "-c", command]) for _ in range(processes)]:
        process.wait()
    return time.perf_counter() - begun


def test_five_thousand_cells_are_planned_in_five_seconds(benchmark, tmp_path):
    spec = large()

    def plan() -> Plan:
        return plan_against(lay_out(spec), Layout(tmp_path / "absent"))

    found = benchmark.pedantic(plan, rounds=2, warmup_rounds=0)
    assert len(found.grid.cells) >= 5_000
    assert benchmark.stats.stats.min < 5


@pytest.mark.parametrize(
    ("arguments", "limit"),
    [(("--help",), 0.3), (("plan", "specs/table1.yaml", "--results", "/nowhere"), 1.0)],
)
def test_the_command_line_answers_at_once(benchmark, arguments, limit):
    """Beside Python that imports the two libraries which every command needs."""

    def seconds(*command: str) -> float:
        begun = time.perf_counter()
        subprocess.run([sys.executable, *command], cwd=ROOT, check=True, capture_output=True)
        return time.perf_counter() - begun

    benchmark.pedantic(seconds, ("-m", "wasp_cli", *arguments), rounds=5, warmup_rounds=1)
    imports = min(seconds("-c", "import typer, pydantic") for _ in range(5))
    benchmark.extra_info["times_its_libraries"] = benchmark.stats.stats.min / imports
    assert benchmark.stats.stats.min < limit
