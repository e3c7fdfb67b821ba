"""What a shell offers behind TAB."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from wasp_cli.cli.app import app
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


def test_a_shell_asks_through_its_environment_and_nothing_heavy_is_imported() -> None:
    line = "wasp run specs/smoke.yaml --set wasp.ca"
    asked = {"_WASP_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": "4", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", WASP]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False, env={**os.environ, **asked})
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, ["wasp.candidates="], "HEAVY []\n")


def offered(line: str) -> list[str]:
    """What bash is offered for the last word of a line, which may be empty."""
    asked = {"_WASP_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
    return CliRunner().invoke(app, [], env=asked).stdout.split()


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
        ("wasp sweep specs/smoke.yaml --vary diffusion.r", ["diffusion.ratio="]),
        ("wasp run specs/smoke.yaml --set ", [f"{name}=" for name in settings()]),
        ("wasp run nowhere/", []),
    ],
)
def test_what_is_offered(line: str, names: list[str]) -> None:
    assert sorted(offered(line)) == sorted(names)


def test_specs_are_offered_from_here_and_from_their_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("mine.yaml", "notes.txt", "specs/quick.yaml", "specs/deep/far.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert offered("wasp run ") == ["mine.yaml", "specs/quick.yaml", *shipped_names()]
    assert offered("wasp check mine.yaml s") == ["specs/quick.yaml", *(name for name in shipped_names() if name[0] == "s")]
    assert offered("wasp check specs/deep/") == ["specs/deep/far.yaml"]
    assert offered(f"wasp plan {tmp_path}/m") == [f"{tmp_path}/mine.yaml"]


def test_a_plugin_that_does_not_load_offers_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: object) -> None:
        raise WaspError("plugin 'x' does not load")

    monkeypatch.setattr("wasp_cli.registry.Registry._entries", broken)
    monkeypatch.setattr("wasp_cli.spec.hints.settings", lambda: broken(OPERATORS))
    assert task_names() == method_names() == variant_names() == setting_names() == []
