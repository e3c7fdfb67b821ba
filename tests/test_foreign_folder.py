"""A results folder of somebody else as the working directory: modules that lie there are
imported by no process of ours.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from http.client import HTTPConnection
from pathlib import Path

import pytest

from tests.view.conftest import brought
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.plan import plan_against
from wasp_cli.run.record import new_run
from wasp_cli.spec.load import load
from wasp_cli.store.layout import Layout

ROOT = Path(__file__).parents[1]
CELL = "goal1 s1 csa noisy=0.45"  # its models ship
DECOYS = (
    "numpy",
    "joblib",
    "pickle",
    "typing",
    "torch",
    "mujoco",
    "pyarrow",
    "PIL",
    "matplotlib",
    "gymnasium",
    "uvicorn",
    "rich",
    "json",
    "multiprocessing",
    "random",
    "struct",
    "signal",
    "threading",
    "subprocess",
    "tempfile",
    "cloudpickle",
    "runner_up",
)
"""Modules of Python, of libraries, and one that nothing names."""
SETTINGS = (
    "preset=smoke",
    "expert.interactions=400",
    "expert.envs=4",
    "expert.evaluation_episodes=1",
)
SPEC = (
    "name: tiny\npreset: smoke\ntasks: [goal1]\nmethods: [human]\noperators: {noisy: "
    "{moderate: 0.4}}\nseeds: [0]\n"
)


@pytest.fixture
def theirs(tmp_path) -> Path:
    """Results with a module of every name in DECOYS; each notes when it is imported."""
    folder = brought(tmp_path / "results", CELL)
    for name in DECOYS:
        (folder / f"{name}.py").write_text(
            f"open({str(tmp_path)!r} + '/imported-{name}', 'w').close()\n", encoding="utf-8"
        )
    (folder / "tiny.yaml").write_text(SPEC, encoding="utf-8")
    found, layout = load(folder / "tiny.yaml"), Layout(folder)
    new_run(layout, found, plan_against(lay_out(found.spec), layout))
    return folder


def imported(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.parent.glob("imported-*"))


def started(folder: Path, *arguments: str, safe: bool = True) -> subprocess.Popen[str]:
    """Start `wasp` as its console script does, which does not search the working directory; or
    as `python -m wasp_cli`, which does.
    """
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"} | {
        "COLUMNS": "200",
        "NO_COLOR": "1",
    }
    command = [sys.executable, *(["-P"] if safe else []), "-m", "wasp_cli", *arguments]
    return subprocess.Popen(
        command,
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=variables,
    )


def done(folder: Path, *arguments: str, safe: bool = True) -> str:
    process = started(folder, *arguments, safe=safe)
    out, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    return out


RUN = (
    "run",
    "tiny.yaml",
    "-j",
    "1",
    "--results",
    ".",
    "--reuse",
    "none",
    "--select",
    "stage=expert",
    *(part for each in SETTINGS for part in ("--set", each)),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["view", ".", "--bundle", "../b", "--cell", CELL, "--episodes", "0"],
        RUN,
        ["replay", CELL, "-e", "0", "-o", "../a.gif", "--results", "."],
        [
            "drive",
            "goal1",
            "--method",
            "human",
            "--simulate",
            "--episodes",
            "1",
            "--speed",
            "4",
            "--results",
            ".",
        ],
    ],
    ids=lambda arguments: arguments[0],
)
def test_no_command_imports_what_lies_there(arguments, theirs):
    done(theirs, *arguments)
    if "--bundle" in arguments:
        assert list(theirs.parent.glob("b/**/00000.*")), "a film was drawn"
    assert imported(theirs) == []


def test_neither_does_python_m(theirs, tmp_path):
    """What Python itself imports before the first line of ours is beyond us: Python 3.12 imports
    `threading`.
    """
    (tmp_path / "first.py").write_text("import sys\nprint(*sys.modules)\n", encoding="utf-8")
    by_python = subprocess.run(
        [sys.executable, "-m", "first"], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout.split()
    for name in set(DECOYS).intersection(by_python):
        (theirs / f"{name}.py").unlink()
    assert len(list(theirs.glob("*.py"))) > 15
    done(theirs, "report", ".", "--no-trained", safe=False)
    assert imported(theirs) == []


def test_a_film_on_demand_imports_nothing_from_there(theirs):
    process = started(theirs, "view", ".", "--no-browser")
    try:
        found = re.search(r"view here: http://127\.0\.0\.1:(\d+)(\S+)", process.stdout.readline())
        connection = HTTPConnection("127.0.0.1", int(found[1]), timeout=600)

        def ask(method: str, place: str, **headers: str) -> tuple[str, str]:
            connection.request(method, place, headers=headers)
            answer = connection.getresponse()
            return (answer.getheader("set-cookie") or "").partition(";")[0], answer.read().decode(
                errors="replace"
            )

        cookie, _ = ask("GET", found[2])
        (key,) = (path.name for path in (theirs / "store" / "evaluate").iterdir())
        place, origin = f"/film/{key}/0/film", f"http://127.0.0.1:{found[1]}"
        state = json.loads(ask("POST", place, Cookie=cookie, Origin=origin)[1])
        end = time.monotonic() + 600
        while state["state"] == "drawing" and not state["ready"]:
            assert time.monotonic() < end
            time.sleep(0.2)
            state = json.loads(ask("GET", place, Cookie=cookie)[1])
        assert state["ready"], "its process has drawn a frame, with all that it imports for that"
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate()
    assert imported(theirs) == []


def test_a_module_that_a_spec_names_is_still_found_beside_it(tmp_path):
    shutil.copy(ROOT / "docs" / "examples" / "puddle.py", tmp_path)
    spec = SPEC.replace("goal1", "puddle:Puddle-v0")
    (tmp_path / "tiny.yaml").write_text(spec, encoding="utf-8")
    assert "1 cells to evaluate" in done(tmp_path, "plan", "tiny.yaml")
