"""What a shell offers behind TAB, asked as a shell asks: through environment variables, in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from wasp_cli.cli.options import method_names, setting_names, task_names, variant_names
from wasp_cli.errors import WaspError
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.spec.hints import settings
from wasp_cli.spec.shipped import shipped_names
from wasp_cli.tasks.registry import TASKS

ROOT = Path(__file__).parents[2]
HEAVY = ["torch", "mujoco", "joblib", "stable_baselines3", "gymnasium", "pyarrow", "matplotlib"]
WASP = (
    "import atexit, sys\n"
    "sys.argv[0] = 'wasp'\n"
    f"atexit.register(lambda: print('HEAVY', [name for name in {HEAVY} if name in sys.modules], file=sys.stderr))\n"
    "from wasp_cli.cli.app import main\n"
    "main()\n"
)


def offered(line: str, folder: Path = ROOT) -> list[str]:
    """What bash is offered for the last word of a line, which may be empty."""
    words = line.split(" ")
    asked = {"_WASP_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", WASP]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600, check=False, env={**os.environ, **asked})
    assert done.returncode == 0, done.stderr
    assert done.stderr == "HEAVY []\n"
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("wasp run --task g", ["goal0", "goal1", "goal1-two", "goal2"]),
        ("wasp run specs/smoke.yaml -t ", list(TASKS)),
        ("wasp list ", ["methods", "operators", "tasks"]),
        ("wasp s", ["schema", "show", "status", "sweep"]),
        ("wasp sweep specs/smoke.yaml --method ", list(METHODS)),
        ("wasp ablate --variant no", ["no-case2", "no-rollout"]),
        ("wasp ablate --preset ", ["smoke", "quick", "cpu", "gpu", "paper"]),
        ("wasp run specs/smoke.yaml --set wasp.ca", ["wasp.candidates="]),
        ("wasp sweep specs/smoke.yaml --vary diffusion.r", ["diffusion.ratio="]),
        ("wasp check specs/table", ["specs/table1.yaml", "specs/table2.yaml"]),
        ("wasp run ./specs/q", ["./specs/quickstart.yaml"]),
        ("wasp run nowhere/", []),
    ],
)
def test_what_is_offered(line: str, names: list[str]) -> None:
    assert sorted(offered(line)) == sorted(names)


def test_specs_are_offered_from_here_and_from_their_folder(tmp_path: Path) -> None:
    for name in ("mine.yaml", "notes.txt", "specs/quick.yaml", "specs/deep/far.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert offered("wasp run ", tmp_path) == ["mine.yaml", "specs/quick.yaml", *shipped_names()]
    assert offered("wasp check mine.yaml s", tmp_path) == ["specs/quick.yaml", *(name for name in shipped_names() if name[0] == "s")]
    assert offered("wasp check specs/deep/", tmp_path) == ["specs/deep/far.yaml"]
    assert offered(f"wasp plan {tmp_path}/m", tmp_path) == [f"{tmp_path}/mine.yaml"]


def test_every_setting_of_a_spec_is_offered() -> None:
    assert offered("wasp run specs/smoke.yaml --set ") == [f"{name}=" for name in settings()]


def test_a_plugin_that_does_not_load_offers_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: object) -> None:
        raise WaspError("plugin 'x' does not load")

    monkeypatch.setattr("wasp_cli.registry.Registry._entries", broken)
    monkeypatch.setattr("wasp_cli.spec.hints.settings", lambda: broken(OPERATORS))
    assert task_names() == method_names() == variant_names() == setting_names() == []
