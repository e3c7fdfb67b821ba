from __future__ import annotations

import pytest

from wasp_cli.tasks import speed
from wasp_cli.tasks.registry import TASKS


@pytest.mark.parametrize("name", list(TASKS))
def test_every_task_can_be_measured(name):
    found = speed.measure(name, seconds=0.01)
    assert found.task == name
    assert all(figure > 0 for figure in found[1:])


def test_the_command_prints_a_table(monkeypatch, capsys):
    measure = speed.measure
    monkeypatch.setattr(speed, "measure", lambda name: measure(name, seconds=0.01))
    assert speed.main(["goal0"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert lines[2].split()[0] == "goal0"


def test_an_unknown_task_is_an_error(capsys):
    assert speed.main(["gaol1"]) == 2
    error = capsys.readouterr().err
    assert "gaol1" in error
    assert "did you mean 'goal1'?" in error
