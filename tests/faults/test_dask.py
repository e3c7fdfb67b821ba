"""The grid through a real dask scheduler and its worker processes."""

import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.commands import run_here
from tests.commands import wasp as real_wasp  # with the real stages
from tests.run.harness import (
    ROOT,
    Fakes,
    as_undisturbed,
    data_of,
    finished,
    goes_on,
    run,
    start,
    wait_until,
    wasp,
)
from wasp_cli.errors import WaspError
from wasp_cli.run.pools.dask import DaskPool
from wasp_cli.run.pools.slurm import SlurmPool


@dataclass
class Cluster:
    """Where it is, and who works for it."""

    address: str
    processes: list[subprocess.Popen[str]]
    add: Callable[[str], None]
    """Start one more worker, of this name."""


@contextmanager
def dask_cluster(folder: Path, workers: int = 2, cwd: Path = ROOT) -> Iterator[Cluster]:
    """Start it, and end it with all its processes. The workers' working directory is `cwd`."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    started: list[subprocess.Popen[str]] = []

    def start(name: str, *arguments: str) -> Path:
        log = folder / f"{name}.log"
        with log.open("w", encoding="utf-8") as file:
            command = [sys.executable, "-m", "dask", *arguments]
            started.append(
                subprocess.Popen(
                    command,
                    cwd=cwd,
                    env=environment,
                    stdout=file,
                    stderr=file,
                    text=True,
                    start_new_session=True,
                )
            )
        return log

    folder.mkdir(parents=True, exist_ok=True)
    try:
        log = start(
            "scheduler", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"
        )
        wait_until(lambda: "Scheduler at:" in log.read_text(encoding="utf-8"))
        line = next(
            line for line in log.read_text(encoding="utf-8").splitlines() if "Scheduler at:" in line
        )
        address = line.partition("Scheduler at:")[2].strip()
        local = (
            "--local-directory",
            str(folder / "scratch"),
            "--no-dashboard",
            "--host",
            "127.0.0.1",
        )

        def add(*names: str) -> None:
            logs = [start(name, "worker", address, "--nthreads", "1", *local) for name in names]
            wait_until(
                lambda: all("Registered to:" in log.read_text(encoding="utf-8") for log in logs)
            )

        add(*(f"worker{number}" for number in range(workers)))
        yield Cluster(address, started, add)
    finally:
        for process in started:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait(timeout=300)


def through(cluster: Cluster) -> tuple[str, ...]:
    """Options of a run whose nodes the cluster computes."""
    return "--backend", "dask", "--scheduler", cluster.address


@pytest.mark.slow
def test_a_grid_has_the_same_bytes_and_what_refuses_or_kills_its_worker_is_named(
    fakes, small_spec, results, tmp_path
):
    fakes.set(
        seconds=0.05, behave={"s0 ida_q": "refuse", "goal1 s0 evaluate human {} noisy": "kill"}
    )
    with dask_cluster(tmp_path / "dask", workers=1) as cluster:
        done = wasp("run", small_spec, "--results", results, *through(cluster), code=1)
    assert "2 failed:\n" in done.stderr
    assert "goal1 s0 ida_q: the loss is not finite" in done.stderr
    assert "goal1 s0 human noisy=0.2: its process was killed" in done.stderr
    fakes.set()
    run(small_spec, tmp_path / "here")
    assert len(data_of(results)) == 18 - 2 - 3, "a calibration and two cells need what refused"
    assert data_of(results).items() <= data_of(tmp_path / "here").items()


def test_a_result_that_cannot_be_fetched_is_lost_and_waits_for_nobody():
    """The scheduler dies between the end of a node and the answer."""

    class Ended:
        status = "finished"

        def result(self) -> None:
            raise OSError("Timed out")

        def add_done_callback(self, told: Callable[[Any], None]) -> None:
            told(self)

    pool = object.__new__(DaskPool)
    pool._pending, pool._number = set(), count()
    pool._client = SimpleNamespace(submit=lambda *_, **__: Ended())
    with pytest.raises(WaspError, match="the dask scheduler is lost"):
        pool.submit(SimpleNamespace(run_id="r", key="k")).result(timeout=5)
    assert not pool._pending


@pytest.mark.slow
def test_a_worker_that_does_not_see_the_folder_computes_nothing(fakes, small_spec, tmp_path):
    """By a path that leads every process to another folder: that of its own working directory."""
    here, there, results = tmp_path / "here", tmp_path / "there", Path("/proc/self/cwd/results")
    here.mkdir()
    there.mkdir()
    with dask_cluster(tmp_path / "dask", workers=1, cwd=there) as cluster:
        done = wasp("run", small_spec, "--results", results, *through(cluster), cwd=here, code=1)
    assert f"error: {platform.node()} does not see the results folder '{results}'" in done.stderr
    assert "every worker needs it under the same path" in done.stderr
    assert not list(there.iterdir())
    assert not list(here.glob("results/store/*/*"))


@pytest.mark.slow
def test_a_run_without_workers_says_so_and_goes_on_when_one_comes(
    fakes, small_spec, results, tmp_path
):
    fakes.set(seconds=0.3)
    with dask_cluster(tmp_path / "dask") as cluster:
        process = start("run", small_spec, "--results", results, *through(cluster))
        wait_until(lambda: len(finished(results)) >= 3)
        for worker in cluster.processes[1:]:
            os.killpg(worker.pid, signal.SIGKILL)
        wait_until(lambda: "no worker is left" in run_here("status", results, columns=200).stdout)
        told = run_here("status", results, columns=200).stdout
        (state,) = json.loads(run_here("status", results, "--json", columns=200).stdout)
        fakes.set()
        cluster.add("late")
        _, errors = process.communicate(timeout=600)
    way = (
        "all dask workers are gone; the run waits, and goes on when one is there: dask worker "
        f"{cluster.address} --nthreads 1"
    )
    assert way in told
    assert " left" not in told.replace("no worker is left", "")
    assert (state["state"], state["left_seconds"]) == ("running", None)
    assert state["deserted"].startswith(way)
    assert way in errors
    assert errors.index(way) < errors.index("workers are back")
    assert process.returncode == 0, errors
    assert as_undisturbed(small_spec, results)


@pytest.mark.slow
def test_a_scheduler_that_dies_ends_the_run_and_the_next_one_goes_on(
    fakes, small_spec, results, tmp_path
):
    """dask would wait for ever."""
    fakes.set(seconds=0.3)
    with dask_cluster(tmp_path / "dask") as cluster:
        process = start("run", small_spec, "--results", results, *through(cluster))
        wait_until(lambda: len(finished(results)) >= 3)
        os.killpg(cluster.processes[0].pid, signal.SIGKILL)
        _, errors = process.communicate(timeout=600)
    assert process.returncode == 1
    assert "error: the dask scheduler is lost" in errors
    goes_on(fakes, small_spec, results)
    assert len(finished(results)) == 18


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--backend", "dask"), "the backend dask needs the address of its scheduler"),
        (
            ("--backend", "dask", "--scheduler", "nonsense"),
            "'nonsense' is not the address of a dask scheduler",
        ),
        (
            ("--backend", "dask", "--scheduler", "tcp://127.0.0.1:1"),
            "no dask scheduler answers at 'tcp://127.0.0.1:1': connection refused",
        ),
        (("--backend", "dusk"), "unknown backend 'dusk'"),
        (
            ("--scheduler", "tcp://127.0.0.1:1"),
            "--scheduler is for the backends dask and slurm",
        ),
    ],
)
def test_a_backend_that_is_not_there_is_a_usage_error(arguments, message, small_spec, tmp_path):
    assert (
        message
        in run_here(
            "run", small_spec, "--results", tmp_path / "results", *arguments, columns=400, code=2
        ).stderr
    )


# The grid as Slurm jobs: submitit is real, and `sbatch`, `srun`, `sacct` and `scancel` run the jobs
# on this machine.


SBATCH = """\
import os, pathlib, subprocess, sys
folder = pathlib.Path(os.environ["FAKE_SLURM"])
number = str(len(list(folder.glob("*.id"))) + 1)
script = sys.argv[-1]
if (folder / "busy").exists():
    sys.exit((folder / "busy").unlink() or "sbatch: error: Socket timed out")
if "refused" in pathlib.Path(script).read_text():
    sys.exit("sbatch: error: invalid partition specified: refused")
environment = {**os.environ, "SLURM_JOB_ID": number, "SLURM_NTASKS": "1", "SLURM_NODEID": "0", "SLURM_PROCID": "0", "SLURM_LOCALID": "0",
    "SLURM_JOB_NUM_NODES": "1", "SLURM_JOB_NODELIST": "here"}
process = subprocess.Popen(["bash", script], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
(folder / f"{number}.id").write_text(str(process.pid))
(folder / f"{number}.sh").write_text(pathlib.Path(script).read_text())
print("Submitted batch job", number)
"""
SRUN = """\
import os, sys
arguments = sys.argv[1:]
while arguments[0].startswith("--"):
    option = arguments.pop(0)
    if option != "--unbuffered":
        arguments.pop(0)
os.execvp(arguments[0], arguments)
"""
SACCT = """\
import os, pathlib, sys
print("JobID|State|NodeList")
for file in pathlib.Path(os.environ["FAKE_SLURM"]).glob("*.id"):
    try:
        os.kill(int(file.read_text()), 0)
        state = "RUNNING"
    except OSError:
        state = "FAILED"
    print(f"{file.stem}|{state}|here")
"""


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the cluster: a process id and a script of each job."""
    pytest.importorskip("submitit")
    folder, programs = tmp_path / "cluster", tmp_path / "bin"
    folder.mkdir()
    programs.mkdir()
    for name, source in {"sbatch": SBATCH, "srun": SRUN, "sacct": SACCT, "scancel": ""}.items():
        program = programs / name
        program.write_text(f"#!{sys.executable}\n{source}", encoding="utf-8")
        program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(folder))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return folder


@pytest.mark.slow
def test_a_grid_as_slurm_jobs_has_the_same_bytes(
    slurm: Path, fakes: Fakes, small_spec: Path, results: Path
) -> None:
    text = (
        small_spec.read_text()
        .replace("[human, ida, wasp, expert]", "[human, expert]")
        .replace("  laggy: {moderate: 0.7}\n", "")
    )
    small_spec.write_text(text)
    options = (
        "--backend",
        "slurm",
        "-j",
        "3",
        "--scheduler",
        "partition=cpu,time=60,cpus_per_task=3",
    )
    wasp("run", small_spec, "--results", results, *options, code=0)
    assert as_undisturbed(small_spec, results)
    scripts = [path.read_text() for path in slurm.glob("*.sh")]
    assert len(scripts) == len(data_of(results))
    assert all(
        '"threads": 3' in path.read_text() for path in results.glob("store/*/*/_manifest.json")
    )
    assert all(
        "--partition=cpu" in script and "--time=60" in script and "--cpus-per-task=3" in script
        for script in scripts
    )


SLOW = """
import os, signal, time
import gymnasium
import numpy as np


class Slow(gymnasium.Env):
    metadata = {"render_modes": [], "render_fps": 20}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1.0, 1.0, 2)
        self.clock = 0
        return self.place.copy(), {}

    def step(self, action):
        time.sleep(0.003)
        self.clock += 1
        self.place = self.place + 0.1 * action + 0.01 * self.np_random.normal(size=2)
        if os.environ.get("SLOW_CRASHES") and self.clock == 70:
            os.kill(os.getpid(), signal.SIGSEGV)
        cost = float(abs(self.place[0]) > 1.0)
        return self.place.copy(), -float(abs(self.place).sum()), False, False, {"cost": cost}


gymnasium.register("Slow-v0", entry_point="slow:Slow", max_episode_steps=160)
"""
SLOW_SPEC = """
name: slow
preset: smoke
task: "slow:Slow-v0"
methods: [human]
operators: {noisy: {mild: 0.3}}
seeds: [0]
expert: {interactions: 160, envs: 4, evaluation_episodes: 8}
"""


@pytest.mark.slow
def test_environments_in_slurm_jobs_are_those_of_this_machine_and_a_crash_is_named(
    slurm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job with two cores steps them in two processes."""
    (tmp_path / "slow.py").write_text(SLOW, encoding="utf-8")
    (tmp_path / "slow.yaml").write_text(SLOW_SPEC, encoding="utf-8")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    only = ("run", "slow.yaml", "--select", "stage=expert", "--results")
    on_slurm = ("--backend", "slurm", "-j", "2", "--scheduler", "partition=cpu,cpus_per_task=2")
    real_wasp(tmp_path, *only, "here", "-j", "1", code=0)
    real_wasp(tmp_path, *only, "there", *on_slurm, code=0)
    skills = [
        {path.name: path.read_bytes() for path in (tmp_path / results).rglob("skill-*.safetensors")}
        for results in ("here", "there")
    ]
    assert skills[0]
    assert skills[0] == skills[1]
    (manifest,) = (tmp_path / "there").rglob("expert/*/_manifest.json")
    assert json.loads(manifest.read_text())["provenance"]["threads"] == 2
    monkeypatch.setenv("SLOW_CRASHES", "1")
    done = real_wasp(tmp_path, *only, "crashed", *on_slurm, code=1)
    assert "environment 'slow:Slow-v0': the process of row" in done.stderr
    assert "was ended by SIGSEGV" in done.stderr


@pytest.mark.slow
def test_a_killed_slurm_job_is_told_and_the_rest_is_kept(
    slurm: Path, fakes: Fakes, small_spec: Path, tmp_path: Path
) -> None:
    fakes.set(behave={"s0 world_model": "kill"})
    assert (
        "world_model"
        in wasp(
            "run",
            small_spec,
            "--results",
            tmp_path / "results",
            "--backend",
            "slurm",
            "-j",
            "2",
            code=1,
        ).stderr
    )
    assert data_of(tmp_path / "results")


def test_jobs_that_end_while_others_are_cancelled_stop_nothing() -> None:
    pool, cancelled = SlurmPool(2, None), []

    def cancel(check: bool) -> None:
        cancelled.append(check)
        pool._pending.popitem()

    pool._pending.update(
        {Future(): SimpleNamespace(done=lambda: False, cancel=cancel) for _ in range(2)}
    )
    pool.close(kill=True)
    assert len(cancelled) == 2


def test_what_sbatch_refuses_is_told(
    slurm: Path, fakes: Fakes, small_spec: Path, tmp_path: Path
) -> None:
    done = wasp(
        "run",
        small_spec,
        "--results",
        tmp_path / "results",
        "--backend",
        "slurm",
        "--scheduler",
        "partition=refused",
        code=1,
    )
    assert "Slurm takes no job" in done.stderr
    assert "invalid partition" in done.stderr
    (slurm / "busy").touch()
    done = wasp(
        "run",
        small_spec,
        "--results",
        tmp_path / "results",
        "--select",
        "stage=expert,seed=0",
        "--backend",
        "slurm",
    )
    assert "Slurm takes no job: sbatch: error: Socket timed out" in done.stderr
    assert len(finished(tmp_path / "results")) == 1


def test_bad_options_and_a_machine_without_slurm_are_told_before_anything_runs(
    slurm: Path, small_spec: Path, tmp_path: Path
) -> None:
    options = ("run", small_spec, "--results", tmp_path / "none", "--backend", "slurm")
    for scheduler, said in (
        ("partition", "not an option of sbatch"),
        ("color=red", "knows"),
        ("a b=c", "not an option of sbatch"),
    ):
        assert said in run_here(*options, "--scheduler", scheduler, columns=200, code=2).stderr
    (tmp_path / "bin" / "sbatch").unlink()
    assert "needs sbatch" in run_here(*options, columns=200, code=2).stderr
    assert not (tmp_path / "none").exists()
