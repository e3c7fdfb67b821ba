"""A declared environment through `wasp plan` and `wasp run`: what is computed, and what is not."""

import json
from pathlib import Path

import pytest

from tests.commands import wasp

SPEC = """\
name: swing
preset: smoke
tasks:
  - id: Pendulum-v1
    name: swing
    make: {{g: {gravity}}}
    image: none
    cost: terminated
    limit: 40
    action_repeat: 2
methods: [human, wasp]
operators:
  noisy: {{mild: 0.2}}
seeds: [0]
expert: {{interactions: 400, envs: 4, evaluation_episodes: 2}}
"""


@pytest.fixture
def home(tmp_path) -> Path:
    (tmp_path / "swing.yaml").write_text(SPEC.format(gravity=9.0), encoding="utf-8")
    return tmp_path


def run_expert(home: Path) -> None:
    done = wasp(home, "run", "swing.yaml", "--select", "stage=expert", "--results", "r")
    assert done.returncode == 0, done.stderr


def missing(home: Path) -> set[str]:
    """Return the labels of what a plan would compute."""
    done = wasp(home, "plan", "swing.yaml", "--results", "r", "--json")
    assert done.returncode == 0, done.stderr
    nodes = json.loads(done.stdout)["nodes"]
    return {node["label"] for node in nodes if node["state"] != "cached"}


def test_a_second_run_computes_nothing_and_another_argument_everything(home):
    everything = missing(home)
    assert "swing s0 expert" in everything
    run_expert(home)
    assert everything - missing(home) == {"swing s0 expert"}
    (manifest,) = (home / "r").rglob("expert/*/_manifest.json")
    settings = json.loads(manifest.read_text())["settings"]
    assert settings["action_repeat"] == 2
    assert settings["environment"]["make"] == {"g": 9.0}
    acting = json.loads((manifest.parent / "acting.json").read_text())
    assert acting["mode"]["episodes"] == acting["mean"]["episodes"] == 6
    for skill in manifest.parent.glob("skill-*.json"):
        assert json.loads(skill.read_text()).get("acts", "mode") == acting["acts"]
    written = manifest.stat().st_mtime_ns
    run_expert(home)
    assert manifest.stat().st_mtime_ns == written
    (home / "swing.yaml").write_text(SPEC.format(gravity=8.0), encoding="utf-8")
    assert missing(home) == everything


def test_a_module_beside_the_spec_is_found_from_any_folder(home):
    spec = SPEC.format(gravity=9.0).replace("cost: terminated", "cost: turning:fast")
    folder = home / "mine"
    folder.mkdir()
    (folder / "swing.yaml").write_text(spec, encoding="utf-8")
    (folder / "turning.py").write_text(
        "def fast(env, action, info):\n    return abs(env.unwrapped.state[1]) > 1\n",
        encoding="utf-8",
    )
    extending = "extends: mine/swing.yaml\nname: again\n"
    (home / "again.yaml").write_text(extending, encoding="utf-8")
    select = ("--select", "stage=expert", "--results", "r")
    done = wasp(home, "run", "mine/swing.yaml", *select)
    assert done.returncode == 0, done.stderr
    # The spec that extends it has the same module, and the same expert.
    done = wasp(home, "run", "again.yaml", *select)
    assert done.returncode == 0, done.stderr
    assert len(list((home / "r").rglob("expert/*/_manifest.json"))) == 1
