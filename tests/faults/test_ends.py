"""What environments have begun ends with the node, with the run, and with whoever is killed."""

import os
import signal
import subprocess
import sys

import pytest

from tests.faults.simulated import KINDS, NODES, Home
from tests.faults.test_random_kills import children, kill_workers
from tests.run import fake_stages
from tests.run.harness import ROOT, finished, wait_until


@pytest.fixture
def home(tmp_path, monkeypatch):
    for name in (fake_stages.OPTIONS, "WASP_SIMULATORS"):
        monkeypatch.setenv(name, "")
    made = Home(tmp_path)
    yield made
    for process in made.left():
        process.kill()


@pytest.mark.parametrize("jobs", ["2", "0"])
def test_every_environment_is_closed_and_none_is_left(jobs, home):
    home.run("Sim", "-j", jobs)
    assert len(finished(home.results)) == NODES
    # one in each process that reads what it says, and two in every node
    processes = 1 if jobs == "0" else 2
    assert len(home.closed()) >= processes + 2 * NODES
    assert not home.left()
    assert not home.notes()


def test_environments_of_a_node_that_fails_or_takes_too_long_are_closed(home):
    home.set(behave={"expert": "raise"})
    assert "ZeroDivisionError" in home.run("Sim", "-j", "1", code=1)
    # three where the spec is read, one where the worker asks again, and two of the node
    assert len(home.closed()) == 3 + 1 + 2
    home.require_none_left()
    home.set(behave={"expert": "sleep"})
    said = home.run("Sim", "-j", "1", "--timeout", "4s", code=1)
    assert "longer than the limit of 4.0 s" in said
    assert len(home.closed()) == 2 * (3 + 1 + 2)
    home.require_none_left()


@pytest.mark.parametrize(
    ("kind", "jobs", "said"),
    [
        ("Raising", "1", "failed to close: OSError: the simulator does not answer"),
        ("Raising", "0", "failed to close: OSError: the simulator does not answer"),
        pytest.param("Deaf", "1", "did not close within 10 s", marks=pytest.mark.slow),
        pytest.param("Deaf", "0", "did not close within 10 s", marks=pytest.mark.slow),
    ],
)
def test_an_environment_that_does_not_close_is_named_and_the_results_are_kept(
    kind, jobs, said, home
):
    """Its processes go with the worker, which gets no further node."""
    printed = home.run(kind, "-j", jobs)
    assert f"environment 'simulators:{kind}-v0' {said} (after" in printed
    assert len(finished(home.results)) == NODES
    assert home.notes() == [f"environment 'simulators:{kind}-v0' {said}"]
    if jobs == "1":
        assert len(set(home.closed())) == 1 + NODES  # the run, and a worker for each node
    home.require_none_left()


@pytest.mark.slow
def test_the_process_of_an_environment_that_hangs_in_native_code_is_ended_and_its_result_kept(
    home,
):
    said = home.run("Native", "-j", "1")
    assert "environment 'simulators:Native-v0' did not come back from close()" in said
    assert len(finished(home.results)) == NODES
    home.require_none_left()


FAST = {("ctrl-c twice", "Sim"), ("worker", "Bare"), ("run", "Daemon"), ("both", "Session")}
ENDS = ("end", "ctrl-c", "ctrl-c twice", "sigterm", "worker", "run", "both")


@pytest.mark.parametrize(
    ("how", "kind"),
    [
        pytest.param(how, kind, marks=() if (how, kind) in FAST else pytest.mark.slow)
        for how in ENDS
        for kind in KINDS
    ],
)
def test_nothing_is_left_however_a_run_ends(how, kind, home):
    home.set(seconds=0.4)
    process = home.start(kind, "-j", "2")
    wait_until(lambda: len(finished(home.results)) >= 2 or process.poll() is not None)
    assert process.poll() is None
    workers = children(process.pid, b"loky")
    if how in ("ctrl-c", "ctrl-c twice"):
        os.killpg(process.pid, signal.SIGINT)
    if how == "ctrl-c twice":
        wait_until(lambda: any(home.results.glob("runs/*/stop")))
        os.killpg(process.pid, signal.SIGINT)
    if how == "sigterm":
        process.terminate()
    if how in ("worker", "both"):
        kill_workers(workers)
    if how in ("run", "both"):
        process.kill()
    _, errors = process.communicate(timeout=600)
    home.require_none_left()
    if how in ("end", "worker"):
        assert process.returncode == 0, errors
    kept = len(finished(home.results))
    home.run(kind, "-j", "2")
    assert len(finished(home.results)) == NODES >= kept
    home.require_none_left()


def test_ctrl_c_lets_the_simulators_of_running_nodes_live(home):
    home.set(seconds=1.0)
    process = home.start("Sim", "-j", "1")
    wait_until(lambda: any(home.results.glob("runs/*/running/*.json")) and len(home.left()) >= 2)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 130
    assert "finishing running nodes" in errors
    assert len(finished(home.results)) == 1, errors
    home.require_none_left()


def test_a_thread_that_nobody_ends_does_not_keep_a_run(home):
    home.run("Talking", "-j", "1")
    assert len(finished(home.results)) == NODES
    home.require_none_left()


@pytest.mark.slow
def test_random_kills_leave_no_simulator_and_lose_nothing():
    """See `kill_simulators`. WASP_KILLS says how many kills, WASP_KILLS_SEED which."""
    options = (
        "--kills",
        os.environ.get("WASP_KILLS", "30"),
        "--seed",
        os.environ.get("WASP_KILLS_SEED", "1"),
    )
    command = [sys.executable, "-m", "tests.faults.kill_simulators", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("nothing was lost\n")


MAKES = """
import time
from wasp_cli.tasks.foreign.closing import environments
from wasp_cli.tasks.foreign.make import make_env

with environments():
    env = make_env("simulators:{}-v0")
    print("made", flush=True)
    time.sleep(1000)
"""


@pytest.mark.parametrize("kind", ["Sim", "Bare", "Daemon"])
def test_a_command_that_is_killed_while_it_asks_an_environment_leaves_nothing(kind, home):
    process = subprocess.Popen(
        [sys.executable, "-c", MAKES.format(kind)],
        cwd=home.folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout.readline() == "made\n"
    try:
        wait_until(lambda: bool(home.left()))
    finally:
        process.kill()
        process.communicate(timeout=60)
    home.require_none_left()
