"""Where no semaphore can be made no worker process starts: a run with one computes by itself, and
others say what is missing.

A process that may write no byte to a file gets no semaphore either, wherever tests run. A container
is tried where this machine lets a process have a /dev of its own.
"""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import ROOT
from tests.run.harness import wasp
from wasp_cli.run.shared_memory import PLACE


def no_bytes_in_files() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))


def unable(*command: str | Path) -> subprocess.CompletedProcess[str]:
    """A process that can make no semaphore."""
    return subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=ROOT,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "300"},
        preexec_fn=no_bytes_in_files,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


def test_one_worker_is_this_process() -> None:
    code = "from wasp_cli.run.pools.choice import pool_of; print(pool_of('loky', 1, None).name)"
    done = unable("-c", code)
    assert done.stdout == "inline\n"
    assert PLACE in done.stderr or sys.platform != "linux"


def test_several_workers_are_refused_before_anything_is_written(small_spec, results) -> None:
    done = unable("tests/run/fake_wasp.py", "run", small_spec, "--results", results, "-j", "2")
    assert done.returncode == 1
    assert "no worker process can be started" in done.stderr
    assert "--shm-size" in done.stderr
    assert "-j 1" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(results.glob("runs/*"))


def test_doctor_has_a_row_of_it_and_of_temporary_files(tmp_path) -> None:
    done = unable("-m", "wasp_cli", "doctor", "--results", tmp_path)
    rows = {
        name: next(line for line in done.stdout.splitlines() if line.strip().startswith(name))
        for name in ("shared memory", "temporary files")
    }
    assert "limited" in rows["shared memory"] or "--shm-size" in rows["shared memory"]
    assert "missing" in rows["temporary files"]
    assert "TMPDIR" in rows["temporary files"]
    assert done.returncode == 1


NO_TEMPORARY_FOLDER = """
import tempfile
from wasp_cli.errors import refusal

try:
    tempfile.gettempdir()
except OSError as error:
    print(refusal(error).hint)
"""


def test_where_no_temporary_file_can_be_written_the_variable_is_named() -> None:
    assert "TMPDIR" in unable("-c", NO_TEMPORARY_FOLDER).stdout


def in_container(mount: str, *command: str | Path) -> subprocess.CompletedProcess[str]:
    """A process for which `mount`, a line of a shell, holds; a test is skipped where this machine
    allows none.
    """
    private = ["unshare", "--mount", *(["--map-root-user"] if os.geteuid() else [])]
    try:
        allowed = not subprocess.run(
            [*private, "sh", "-ec", mount], capture_output=True, check=False
        ).returncode
    except FileNotFoundError:
        allowed = False
    if not allowed:
        pytest.skip("no process may mount anything here")
    return subprocess.run(
        [*private, "sh", "-ec", f'{mount}\nexec "$@"', "sh", *map(str, command)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


CONTAINERS = {
    "full": "mount -t tmpfs -o size=1k tmpfs /dev/shm",
    "read only": "mount -t tmpfs -o ro tmpfs /dev/shm",
    "missing": """
        folder=$(mktemp -d)
        mount -t tmpfs tmpfs $folder
        for name in null zero urandom random; do
            touch $folder/$name
            mount --bind /dev/$name $folder/$name
        done
        mount --rbind $folder /dev
    """,
}


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("jobs", ["1", "2"])
@pytest.mark.slow
def test_a_container_with_shared_memory_that_is(
    container: str, jobs: str, fakes, small_spec, tmp_path
) -> None:
    results = tmp_path / "results"
    command = ["tests/run/fake_wasp.py", "run", small_spec, "--results", results, "-j", jobs]
    done = in_container(CONTAINERS[container], sys.executable, *command)
    if jobs == "2":
        assert done.returncode == 1
        assert f"no worker process can be started: '{PLACE}': " in done.stderr
    else:
        assert done.returncode == 0, done.stderr
        assert PLACE in done.stderr
    assert "Traceback" not in done.stderr
    # what was computed before needs no worker
    wasp("run", small_spec, "--results", results, "-j", "0", code=0)
    again = in_container(CONTAINERS[container], sys.executable, *command)
    assert again.returncode == 0, again.stderr
