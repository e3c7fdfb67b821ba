"""Batches of others' environments in several processes are those of one, and leave nothing."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest

from tests.commands import ROOT
from tests.tasks import tides
from tests.tasks.lights import Lights, registered
from wasp_cli.errors import EnvironmentDied, TaskError
from wasp_cli.tasks.declared import declare
from wasp_cli.tasks.foreign import payoff
from wasp_cli.tasks.foreign.closing import environments
from wasp_cli.tasks.foreign.part import Part
from wasp_cli.tasks.foreign.processes import ProcessTask, foreign_task
from wasp_cli.tasks.foreign.task import GymTask

TIDES, FAILING, DYING, UNWILLING, STARTING = (
    f"tests.tasks.tides:{name}-v0"
    for name in ("Tides", "Failing", "Dying", "Unwilling", "Starting")
)
GONE_SECONDS = 30.0


@pytest.fixture(autouse=True)
def always(monkeypatch):
    """Processes are used however quick an environment is."""
    monkeypatch.setattr(payoff, "DECISION_SECONDS", 0.0)
    monkeypatch.setattr(payoff, "EPISODE_SECONDS", 0.0)


@pytest.fixture
def told(tmp_path, monkeypatch):
    """The file in which environments tell what became of them."""
    path = tmp_path / "told"
    path.touch()
    monkeypatch.setenv(tides.TOLD, str(path))
    return path


def in_processes(name: str, batch: int, count: int, **options) -> ProcessTask:
    task = foreign_task(name, batch, threads=count, **options)
    assert isinstance(task, ProcessTask)
    return task


def bits(observation, *arrays) -> list[bytes]:
    seen = [array for array in observation if array is not None]
    return [np.asarray(array).tobytes() for array in (*seen, *arrays)]


def driven(task) -> list[bytes]:
    """All bits of 60 decisions: episodes end, some rows start anew and others do not, and half of
    the way is gone again from a snapshot.
    """
    draws = np.random.default_rng(0)
    met = bits(task.reset(range(task.batch)))
    seed, kept = task.batch, {}
    for number in range(60):
        step = task.step(draws.uniform(-1.2, 1.0, (task.batch, 2)))
        sources = [step.sources[name] for name in task.cost_sources]
        outcomes = (step.reward, step.cost, step.cost_env, step.goals, step.env_steps)
        met += bits(step.observation, *outcomes, step.ended, step.terminated, *sources)
        again = step.ended & (draws.random(task.batch) < 0.3)
        if step.ended.all():
            again[:] = True
        if again.any():
            count = int(again.sum())
            met += bits(task.reset(range(seed, seed + count), again))
            seed += count
        if number == 20:
            kept = task.snapshot()
            met += [kept[name].tobytes() for name in sorted(kept)]
        if number == 40:
            met += bits(task.restore(kept))
    return met


@pytest.mark.parametrize("observe", [("pixels", "state", "privileged"), ("privileged",)])
def test_rows_are_the_same_to_the_bit_in_any_number_of_processes(observe):
    here = driven(GymTask(TIDES, 5, action_repeat=2, observe=observe))
    for count in (1, 2, 3):
        task = foreign_task(TIDES, 5, action_repeat=2, observe=observe, threads=count)
        assert isinstance(task, ProcessTask) == (count > 1)
        assert driven(task) == here


def test_a_declared_environment_is_declared_in_every_process():
    declaration = {"id": TIDES, "cost": "info.goals", "limit": 30}
    declare("tides", declaration)
    here = driven(GymTask("tides", 3))
    assert driven(in_processes("tides", 3, 2)) == here
    assert here != driven(GymTask(TIDES, 3))


def test_it_says_of_itself_what_one_process_says():
    here, there = GymTask(TIDES, 3), in_processes(TIDES, 3, 2)
    names = [name for name in vars(here) if not name.startswith("_")]
    assert names
    for name in names:
        assert np.array_equal(getattr(here, name), getattr(there, name)), name
    assert [one.dtype for one in here.reset([1, 2, 3])] == [
        one.dtype for one in there.reset([1, 2, 3])
    ]


def test_there_are_no_more_processes_than_rows():
    assert len(in_processes(TIDES, 2, 8).pids) == 2


def test_an_environment_that_takes_no_time_is_stepped_in_this_process(monkeypatch):
    monkeypatch.setattr(payoff, "DECISION_SECONDS", 60.0)
    assert isinstance(foreign_task(TIDES, 4, threads=2), GymTask)
    monkeypatch.setattr(payoff, "DECISION_SECONDS", 0.0)
    monkeypatch.setattr(payoff, "EPISODE_SECONDS", 600.0)
    assert isinstance(foreign_task(TIDES, 4, threads=2), GymTask)


def test_an_id_that_only_this_program_knows_is_stepped_in_this_process():
    assert isinstance(foreign_task(registered(Lights), 4, threads=2), GymTask)


def test_an_error_of_an_environment_is_the_one_of_a_single_process_and_another_episode_begins():
    def failure(task):
        task.reset([0, 2, 4, 7, 9])
        with pytest.raises(TaskError) as caught:
            task.step(np.zeros((5, 2)))
        return caught.value.message, caught.value.hint

    task = in_processes(FAILING, 5, 2)
    said = failure(task)
    assert said == failure(GymTask(FAILING, 5))
    assert "the pump is clogged" in said[0]
    again, fresh = task.reset([0, 2, 4, 6, 8]), GymTask(FAILING, 5).reset([0, 2, 4, 6, 8])
    assert bits(again) == bits(fresh)
    assert task.step(np.zeros((5, 2))).env_steps.tolist() == [4] * 5


@pytest.mark.parametrize(
    "call",
    [
        lambda task: task.step(np.zeros((3, 2))),
        lambda task: task.snapshot(),
        lambda task: (task.reset([0, 1, 2]), task.step(np.full((3, 2), np.nan))),
        lambda task: task.reset([0, 1]),
        lambda task: (task.reset([0], np.arange(3) == 1), task.snapshot()),
    ],
)
def test_wrong_calls_are_refused_as_in_a_single_process(call):
    said = []
    for task in (GymTask(TIDES, 3), in_processes(TIDES, 3, 2)):
        with pytest.raises(TaskError) as caught:
            call(task)
        said.append((caught.value.message, caught.value.hint))
    assert said[0] == said[1]


def test_a_snapshot_of_another_batch_is_refused():
    other = GymTask(TIDES, 4)
    other.reset([0, 1, 2, 3])
    with pytest.raises(TaskError, match="not one of this task with batch 3"):
        in_processes(TIDES, 3, 2).restore(other.snapshot())


def test_a_process_that_is_killed_is_named_with_its_environment_and_its_rows():
    task = in_processes(TIDES, 5, 2)
    task.reset(range(5))
    os.kill(task.pids[1], signal.SIGKILL)
    with pytest.raises(EnvironmentDied, match=r"Tides-v0': the process of rows 3 to 4 .*SIGKILL"):
        task.step(np.zeros((5, 2)))
    with pytest.raises(EnvironmentDied, match="SIGKILL"):
        task.reset(range(5))
    with environments() as scope:
        task.close()
    assert not scope.troubles
    require_gone(task.pids)


def test_an_environment_that_crashes_in_native_code_does_not_take_this_process_along(
    monkeypatch, capfd
):
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    monkeypatch.setenv(tides.MAIN, str(os.getpid()))
    task = in_processes(DYING, 2, 2)
    task.reset([6, 7])
    with pytest.raises(EnvironmentDied, match=r"Dying-v0': the process of row 1 .*SIGSEGV") as died:
        task.step(np.zeros((2, 2)))
    assert "native code" in str(died.value.hint)
    assert "the dam breaks" in capfd.readouterr().err  # what it printed before


def test_every_environment_is_closed_once_and_no_process_is_left(told):
    task = in_processes(TIDES, 5, 2)
    pids = task.pids
    told.write_text("")
    task.close()
    task.close()
    assert sorted(told.read_text().split("\n")[:-1]) == sorted(
        f"closed in {pid}" for pid in [pids[0]] * 3 + [pids[1]] * 2
    )
    require_gone(pids)
    with pytest.raises(TaskError, match="was closed"):
        task.reset(range(5))


def test_processes_that_nobody_holds_end_when_the_next_task_is_made():
    pids = in_processes(TIDES, 4, 2).pids
    GymTask(TIDES, 1)
    require_gone(pids)


def test_what_goes_wrong_in_closing_is_named_once(capfd):
    with environments() as scope:
        in_processes(UNWILLING, 4, 2)
    said = f"environment '{UNWILLING}' failed to close: OSError: the gate is stuck"
    assert scope.troubles == [said]
    assert capfd.readouterr().err.count(said) == 1


def test_a_wait_that_was_broken_off_leaves_no_answer_for_the_next_call(monkeypatch):
    task = in_processes(TIDES, 4, 2)
    task.reset(range(4))

    def interrupted(part):
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr(Part, "answer", interrupted)
        with pytest.raises(KeyboardInterrupt):
            task.step(np.zeros((4, 2)))
    with pytest.raises(TaskError, match="interrupted"):
        task.step(np.zeros((4, 2)))
    pids = task.pids
    task.close()
    require_gone(pids)


def step_somewhere(results):
    task = foreign_task(TIDES, 4, threads=2)
    task.reset(range(4))
    results.put((type(task).__name__, task.step(np.zeros((4, 2))).reward.tolist()))


def test_they_begin_in_a_daemonic_process_as_well():
    """Workers of dask are such processes; multiprocessing allows them no children."""
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    worker = context.Process(target=step_somewhere, args=(results,), daemon=True)
    worker.start()
    kind, rewards = results.get(timeout=60)
    worker.join()
    here = GymTask(TIDES, 4)
    here.reset(range(4))
    assert (kind, rewards) == ("ProcessTask", here.step(np.zeros((4, 2))).reward.tolist())


PROGRAM = """
import json, signal, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
from wasp_cli.tasks.declared import declare
from wasp_cli.tasks.foreign import payoff, processes
from wasp_cli.tasks.foreign.closing import environments
payoff.DECISION_SECONDS = payoff.EPISODE_SECONDS = 0.0
with environments():
    task = processes.foreign_task("tests.tasks.tides:Starting-v0", 4, threads=2)
    print(json.dumps(task.pids), flush=True)
    time.sleep(600)
"""


def test_nothing_is_left_of_a_program_that_is_killed(told, tmp_path):
    program = subprocess.Popen(
        [sys.executable, "-P", "-c", PROGRAM],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
    )
    assert program.stdout is not None
    pids = json.loads(program.stdout.readline())
    pumps = [line.split() for line in told.read_text().splitlines() if line.startswith("pump")]
    in_parts = [(int(pid), ignored) for _, pid, ignored in pumps][-4:]
    assert [ignored for _, ignored in in_parts] == ["False"] * 4
    assert all(map(psutil.pid_exists, [*pids, *(pid for pid, _ in in_parts)]))
    program.kill()
    program.wait()
    program.stdout.close()
    require_gone([*pids, *(int(pid) for _, pid, _ in pumps)])


def require_gone(pids):
    """See that processes are gone soon."""
    end = time.monotonic() + GONE_SECONDS
    while left := [pid for pid in pids if runs(pid)]:
        assert time.monotonic() < end, f"{left} run on"
        time.sleep(0.05)


def runs(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
