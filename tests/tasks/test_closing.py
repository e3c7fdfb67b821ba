"""Environments of others are closed, once each, and what goes wrong in that ends nothing else."""

import time

import pytest

from tests.commands import python
from tests.tasks.lights import Lights, registered
from wasp_cli.errors import TaskError
from wasp_cli.tasks.foreign import closing
from wasp_cli.tasks.foreign.closing import environments
from wasp_cli.tasks.foreign.examine import examine
from wasp_cli.tasks.foreign.task import GymTask


@pytest.fixture
def counted():
    """A class of environments that counts those that were made, and those that were closed."""

    class Counted(Lights):
        made = 0
        closed = 0

        def __init__(self):
            type(self).made += 1

        def close(self):
            type(self).closed += 1

    return Counted


def test_a_task_closes_its_environments_once_and_refuses_to_go_on(counted):
    task = GymTask(registered(counted), 3)
    assert (counted.made, counted.closed) == (4, 1)  # the first one was asked what it is
    task.reset([0, 1, 2])
    task.close()
    task.close()
    assert counted.closed == 4
    for call in (lambda: task.reset([0, 1, 2]), task.snapshot, lambda: task.step(None)):
        with pytest.raises(TaskError, match="was closed"):
            call()


def test_what_nobody_holds_is_closed_when_the_next_task_is_made(counted):
    name = registered(counted)
    circle = [GymTask(name, 2)]
    circle.append(circle)
    kept = GymTask(name, 2)
    del circle
    assert counted.closed == 1
    GymTask(name, 2)
    assert counted.closed == 1 + 2
    kept.reset([0, 1])


def test_all_that_is_open_is_closed_at_the_end_of_a_block_that_fails(counted):
    held = []

    def fail():
        with environments():
            held.append(GymTask(registered(counted), 2))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert counted.closed == counted.made == 3
    with pytest.raises(TaskError, match="was closed"):
        held[0].reset([0, 1])


def test_those_that_were_made_are_closed_where_one_cannot_be_made(counted):
    class Third(counted):
        def __init__(self):
            super().__init__()
            if type(self).made == 3:
                raise OSError("no further window")

    with pytest.raises(TaskError, match="no further window"):
        GymTask(registered(Third), 4)
    assert (Third.made, Third.closed) == (3, 2)


def test_one_that_raises_is_named_and_the_others_are_closed(counted, capsys):
    class Raising(counted):
        def close(self):
            super().close()
            raise OSError("no answer")

    name = registered(Raising)
    with environments() as scope:
        GymTask(name, 3)
    assert Raising.closed == 4
    said = f"environment '{name}' failed to close: OSError: no answer"
    assert scope.troubles == [said]
    assert f"warning: {said}\n" in capsys.readouterr().err


def test_one_that_waits_for_ever_is_left_after_a_time_and_named(counted, monkeypatch):
    monkeypatch.setattr(closing, "CLOSE_SECONDS", 0.2)
    monkeypatch.setattr(closing, "AGAIN_SECONDS", 0.1)

    class Waiting(counted):
        def close(self):
            super().close()
            time.sleep(600)

    name = registered(Waiting)
    with environments() as scope:
        GymTask(name, 2)
    assert Waiting.closed == 3
    assert scope.troubles == [f"environment '{name}' did not close within 0.2 s"]


def test_examining_says_what_is_wrong_with_an_environment_and_closes_it(counted):
    class Silent(counted):
        def info(self):
            return {}

    with pytest.raises(TaskError, match="no 'cost'"):
        examine(registered(Silent))
    assert (Silent.made, Silent.closed) == (1, 1)


PROGRAM = """
import sys
from tests.tasks.lights import Lights, registered
from wasp_cli.tasks.foreign.task import GymTask

class Told(Lights):
    def close(self):
        print("closed", file=sys.stderr)

task = GymTask(registered(Told), 2)
{}
"""


@pytest.mark.parametrize("end", ["", "1 / 0", "sys.exit(3)"])
def test_a_program_that_ends_closes_what_it_holds(end, tmp_path):
    done = python(tmp_path, "-c", PROGRAM.format(end))
    assert done.stderr.count("closed\n") == 3
    assert not done.stdout


def test_a_fork_of_a_program_leaves_the_environments_of_the_program(tmp_path):
    end = "import os\nif not os.fork():\n    sys.exit()\nos.wait()\nprint('mine', file=sys.stderr)"
    done = python(tmp_path, "-c", PROGRAM.format(end))
    assert done.stderr.partition("mine\n")[0].count("closed\n") == 1
    assert done.stderr.count("closed\n") == 3


def test_what_a_program_of_ones_own_starts_besides_is_not_marked(tmp_path):
    """Outside of commands and nodes nothing is ended but by closing."""
    end = "import os\nprint(sorted(name for name in os.environ if name.startswith('WASP_ENV')))"
    assert python(tmp_path, "-c", PROGRAM.format(end)).stdout == "[]\n"
