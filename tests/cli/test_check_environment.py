"""`wasp check` of a spec with an environment of one's own: what it prints, and what it refuses."""

import json
import shutil
from pathlib import Path

import pytest

from tests.commands import ROOT, wasp

SPEC = """\
name: tried
preset: smoke
tasks: [goal1, "{task}"]
methods: [human]
operators: {{noisy: {{mild: 0.2}}}}
seeds: [0]
"""
FAULTY = """
import gymnasium
from puddle import Puddle

class Never(Puddle):
    def step(self, action):
        *done, _ = super().step(action)
        return (*done, {"cost": 0.0})

class Shared(Puddle):
    points = []
    def reset(self, **options):
        first = super().reset(**options)
        Shared.points[:] = [self.point]
        return first
    def step(self, action):
        self.point = Shared.points[0]
        done = super().step(action)
        Shared.points[:] = [self.point]
        return done

for env in (Never, Shared):
    gymnasium.register(f"{env.__name__}-v0", entry_point=env, max_episode_steps=200)
"""


@pytest.fixture
def home(tmp_path) -> Path:
    shutil.copy(ROOT / "docs" / "examples" / "puddle.py", tmp_path)
    (tmp_path / "faulty.py").write_text(FAULTY, encoding="utf-8")
    for name in ("puddle:Puddle", "faulty:Never", "faulty:Shared"):
        spec = SPEC.format(task=f"{name}-v0")
        (tmp_path / f"{name.partition(':')[2]}.yaml").write_text(spec, encoding="utf-8")
    return tmp_path


def test_a_sound_environment_is_told_with_what_was_met_in_it(home):
    done = wasp(home, "check", "Puddle.yaml", "--steps", "300", "--json", code=0)
    (found,) = json.loads(done.stdout)
    told = found["environments"]
    assert list(told) == ["puddle:Puddle-v0"], "tasks that are built in are not tried"
    assert "900 env steps" in told["puddle:Puddle-v0"]["summary"]
    printed = wasp(home, "check", "Puddle.yaml", "--steps", "300", code=0).stdout
    assert "puddle:Puddle-v0" in printed
    assert "of env steps" in printed


@pytest.mark.parametrize(
    ("name", "said"), [("Never", "never costs"), ("Shared", "second instance")]
)
def test_a_faulty_environment_is_refused_at_its_place_in_the_spec(home, name, said):
    done = wasp(home, "check", f"{name}.yaml", "--steps", "300", code=3)
    assert f"{name}.yaml:3:16" in done.stderr
    assert said in done.stderr


def test_a_run_refuses_instances_that_share_something_before_it_computes(home):
    done = wasp(home, "run", "Shared.yaml", "--results", "results", code=3)
    assert "second instance" in done.stderr
    assert not (home / "results").exists()
