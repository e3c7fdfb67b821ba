"""What limits the cores of a run and the threads of its nodes, and that a run keeps to it."""

import json
import random
import subprocess
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.commands import ROOT
from tests.run.harness import prepared
from wasp_cli.errors import UsageError
from wasp_cli.plan.grid import stage_class
from wasp_cli.run import cores
from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.pools.local import InlinePool
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.run.worker import execute_here
from wasp_cli.spec.load import load


@pytest.fixture(autouse=True)
def machine(monkeypatch, tmp_path):
    """64 cores without a limit, whatever runs the tests."""
    for name in (*cores.THREADS, cores.SLURM_CORES):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(64), raising=False)
    monkeypatch.setattr(cores, "CGROUP", tmp_path / "cgroup")
    monkeypatch.setattr(cores, "OWN_CGROUP", tmp_path / "own")


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {"cpu.max": "max 100000"}, 64),
        ("0::/\n", {"cpu.max": "150000 100000"}, 2),
        ("0::/job\n", {"job/cpu.max": "300000 100000"}, 3),
        ("0::/job/step\n", {"job/cpu.max": "300000 100000", "job/step/cpu.max": "max 100000"}, 3),
        ("0::/job/step\n", {"job/cpu.max": "max 100000", "job/step/cpu.max": "50000 100000"}, 1),
        (
            "3:cpu,cpuacct:/docker/a\n",
            {
                "cpu/docker/a/cpu.cfs_quota_us": "200000",
                "cpu/docker/a/cpu.cfs_period_us": "100000",
            },
            2,
        ),
        (
            "3:cpu,cpuacct:/\n",
            {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"},
            64,
        ),
    ],
)
def test_the_control_groups_of_this_process_limit_its_cores(own, files, expected, tmp_path):
    cores.OWN_CGROUP.write_text(own)
    for name, text in files.items():
        path = cores.CGROUP / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")
    assert cores.cores() == expected


def test_a_slurm_job_has_the_cores_that_slurm_gave_it(monkeypatch):
    monkeypatch.setenv("SLURM_CPUS_ON_NODE", "8")
    assert cores.cores() == 8
    monkeypatch.setenv("SLURM_CPUS_ON_NODE", "")
    assert cores.cores() == 64


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({}, None),
        ({"OMP_NUM_THREADS": "1"}, ("OMP_NUM_THREADS", 1)),
        ({"OMP_NUM_THREADS": " 4,2 "}, ("OMP_NUM_THREADS", 4)),
        ({"OMP_NUM_THREADS": "4", "MKL_NUM_THREADS": "2"}, ("MKL_NUM_THREADS", 2)),
        ({"OPENBLAS_NUM_THREADS": "3"}, ("OPENBLAS_NUM_THREADS", 3)),
        ({"OMP_THREAD_LIMIT": "5"}, ("OMP_THREAD_LIMIT", 5)),
        ({"OMP_NUM_THREADS": "many", "MKL_NUM_THREADS": "", "OMP_THREAD_LIMIT": "0"}, None),
    ],
)
def test_the_least_of_the_users_variables_limits_the_threads_of_a_node(
    variables, expected, monkeypatch
):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert cores.thread_limit() == expected


def threads_of(spec: Path, results: Path, **options: int) -> set[int]:
    """The threads that the nodes of a run were given."""
    run_spec(load(spec, ["methods=[]"]), results, RunOptions(**options))
    manifests = [json.loads(path.read_text()) for path in results.glob("store/*/*/_manifest.json")]
    assert manifests
    return {manifest["provenance"]["threads"] for manifest in manifests}


@pytest.fixture
def in_this_process(monkeypatch):
    monkeypatch.setattr("wasp_cli.run.session.pool_of", lambda *_: InlinePool())


@pytest.mark.usefixtures("fakes", "in_this_process")
def test_one_worker_means_one_thread_however_many_cores_there_are(small_spec, tmp_path):
    assert threads_of(small_spec, tmp_path / "one", jobs=1) == {1}
    assert threads_of(small_spec, tmp_path / "none", jobs=0) == {1}


@pytest.mark.usefixtures("fakes", "in_this_process")
def test_a_node_that_runs_alone_has_the_cores_of_the_run(small_spec, tmp_path):
    assert threads_of(small_spec, tmp_path / "results", jobs=4) == {4}


@pytest.mark.usefixtures("fakes", "in_this_process")
def test_a_node_has_no_more_threads_than_the_user_allows(small_spec, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert threads_of(small_spec, tmp_path / "results", jobs=4) == {2}


class Uneven(InlinePool):
    """Runs nodes side by side, which end in an order drawn by chance; `most` is the largest number
    of threads that they ever had together.
    """

    def __init__(self, jobs: int, seed: int) -> None:
        self.jobs, self.most = jobs, 0
        self._draw, self._alone = random.Random(seed), threading.Lock()
        self._threads = ThreadPoolExecutor(jobs)
        self._running: dict[str, int] = {}

    def submit(self, job: NodeJob) -> Future[NodeResult]:
        self._running[job.key] = job.threads
        self.most = max(self.most, sum(tuple(self._running.values())))
        return self._threads.submit(self._compute, job, self._draw.choice([0.0, 0.0, 0.3]))

    def _compute(self, job: NodeJob, delay: float) -> NodeResult:
        with self._alone:  # stdout is sent to the log of a node
            result = execute_here(job)
        time.sleep(delay)
        del self._running[job.key]
        return result

    def close(self, *, kill: bool = False) -> None:
        self._threads.shutdown()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("jobs", "given"), [(2, 2), (8, 8), (8, 4), (2, 3)])
def test_nodes_never_have_more_threads_together_than_the_run_was_given(
    fakes, small_spec, tmp_path, jobs, given, seed
):
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    pool = Uneven(jobs, seed)
    summary = Runner(layout, new_run(layout, loaded, plan), pool, cores=given).run(plan)
    pool.close()
    assert summary.complete
    assert pool.most <= max(jobs, given)


def test_a_stage_that_needs_more_threads_than_are_allowed_is_refused_before_anything_runs(
    fakes, small_spec, tmp_path, monkeypatch
):
    monkeypatch.setattr(stage_class("dataset"), "torch_threads", 4, raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with pytest.raises(UsageError, match="'dataset' computes with 4 threads") as refused:
        run_spec(load(small_spec), tmp_path / "results", RunOptions(jobs=1))
    assert "OMP_NUM_THREADS=4" in str(refused.value.hint)
    assert not fakes.executions()


AFTER_NUMPY = """
import numpy
from threadpoolctl import threadpool_info
from wasp_cli.run.worker import set_threads

set_threads(1)
import torch
print({pool["num_threads"] for pool in threadpool_info()})
"""


def test_libraries_that_were_loaded_before_keep_to_the_threads_of_a_node_too():
    command = [sys.executable, "-c", AFTER_NUMPY]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert told.stdout == "{1}\n"
