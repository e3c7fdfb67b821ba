"""The grid as Slurm jobs: submitit is real, and `sbatch`, `srun`, `sacct` and `scancel` run the jobs on this machine."""

import os
import stat
import sys
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.run.harness import ROOT, Fakes, data_of, run, start

SBATCH = """\
import os, pathlib, subprocess, sys
folder = pathlib.Path(os.environ["FAKE_SLURM"])
number = str(len(list(folder.glob("*.id"))) + 1)
script = sys.argv[-1]
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
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(folder))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return folder


def test_a_grid_as_slurm_jobs_has_the_same_bytes(slurm: Path, fakes: Fakes, small_spec: Path, tmp_path: Path) -> None:
    small_spec.write_text(small_spec.read_text().replace("[human, ida, wasp, expert]", "[human, expert]").replace("[0, 1]", "[0]"))
    results = tmp_path / "results"
    options = ("--backend", "slurm", "-j", "3", "--scheduler", "partition=cpu,time=60")
    first = start("run", small_spec, "--results", results, *options)
    _, errors = first.communicate(timeout=600)
    assert first.returncode == 0, errors
    run(small_spec, tmp_path / "here")
    assert data_of(results) == data_of(tmp_path / "here")
    scripts = [path.read_text() for path in slurm.glob("*.sh")]
    assert len(scripts) == len(data_of(results))
    assert all("--partition=cpu" in script and "--time=60" in script and "--cpus-per-task=" in script for script in scripts)


@pytest.mark.slow
def test_a_killed_slurm_job_is_told_and_the_rest_is_kept(slurm: Path, fakes: Fakes, small_spec: Path, tmp_path: Path) -> None:
    fakes.set(behave={"s0 world_model": "kill"})
    done = start("run", small_spec, "--results", tmp_path / "results", "--backend", "slurm", "-j", "2")
    _, errors = done.communicate(timeout=600)
    assert done.returncode == 1
    assert "world_model" in errors
    assert "Traceback" not in errors
    assert data_of(tmp_path / "results")


def test_what_sbatch_refuses_is_told(slurm: Path, fakes: Fakes, small_spec: Path, tmp_path: Path) -> None:
    done = start("run", small_spec, "--results", tmp_path / "results", "--backend", "slurm", "--scheduler", "partition=refused")
    _, errors = done.communicate(timeout=600)
    assert done.returncode == 1
    assert "Slurm takes no job" in errors
    assert "invalid partition" in errors
    assert "Traceback" not in errors


def test_bad_options_and_a_machine_without_slurm_are_told_before_anything_runs(slurm: Path, small_spec: Path, tmp_path: Path) -> None:
    options = ("run", small_spec, "--results", tmp_path / "none", "--backend", "slurm")
    for scheduler, said in (("partition", "no option of sbatch"), ("color=red", "knows"), ("a b=c", "no option of sbatch")):
        done = run_here(*options, "--scheduler", scheduler, columns=200)
        assert (done.exit_code, said in done.stderr) == (2, True), done.stderr
    (tmp_path / "bin" / "sbatch").unlink()
    done = run_here(*options, columns=200)
    assert (done.exit_code, "needs sbatch" in done.stderr) == (2, True)
    assert not (tmp_path / "none").exists()
