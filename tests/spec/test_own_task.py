"""Specs that name an environment of one's own: what they may write, where mistakes are shown,
and what a changed environment re-runs.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.spec.good import mistakes
from wasp_cli.cells.asked import asked_of
from wasp_cli.cells.runs import read_run
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.plan import plan_against
from wasp_cli.run.record import new_run
from wasp_cli.spec.load import Loaded, chain_of, load, loaded, override
from wasp_cli.spec.read import InvalidSpec, Problem, parse
from wasp_cli.store.layout import Layout

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"

SPEC = """\
name: own
preset: smoke
{line}
methods: [human, wasp, expert]
operators:
  noisy: {{mild: 0.2}}
seeds: [0]
"""


def read(line: str, *settings: str) -> Loaded:
    overrides = [override(number, text) for number, text in enumerate(settings, start=1)]
    return loaded(chain_of(parse(SPEC.format(line=line), "x.yaml")), overrides)


def only(line: str, *settings: str) -> Problem:
    with pytest.raises(InvalidSpec) as caught:
        read(line, *settings)
    (problem,) = caught.value.problems
    return problem


def test_one_task_may_be_written_without_a_list():
    for line in (
        "task: puddle:Puddle-v0",
        "tasks: [puddle:Puddle-v0]",
        "tasks:\n  - puddle:Puddle-v0",
    ):
        assert read(line).spec.tasks == ("puddle:Puddle-v0",)
    assert read("task: goal1").spec == read("tasks: [goal1]").spec


@pytest.mark.parametrize(
    ("line", "column", "message", "hint"), mistakes("own_task: mistakes have a place and a remedy")
)
def test_mistakes_have_a_place_and_a_remedy(line, column, message, hint, tmp_path, monkeypatch):
    module = """\
import gymnasium
import puddle
gymnasium.register('Puddle-v1', entry_point='puddle:Puddle')
class Fails(puddle.Puddle):
    def step(self, action):
        raise RuntimeError('the wheel fell off')
gymnasium.register('Fails-v0', entry_point=Fails, max_episode_steps=5)
"""
    (tmp_path / "unlimited.py").write_text(module, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    problem = only(line)
    assert (problem.position.line, problem.position.column) == (3, column)
    assert message in problem.message
    assert hint in (problem.hint or "")


PLAN = """
import json, sys
from pathlib import Path
from tests.plugins import forget
from wasp_cli.plan.grid import lay_out
from wasp_cli.spec.load import load

sys.dont_write_bytecode = True
found = []
for files in json.load(sys.stdin):
    for name, text in files.items():
        Path("my_env", name).write_text(text, encoding="utf-8")
    forget("my_env")
    found.append({node.label: node.key for node in lay_out(load(Path("spec.yaml")).spec).nodes})
print(json.dumps(found))
"""


def test_keys_cover_the_source_and_the_registration_of_the_environment(tmp_path):
    text = (
        (EXAMPLES / "puddle.py")
        .read_text(encoding="utf-8")
        .replace("puddle:Puddle", "my_env.puddle:Puddle")
    )
    with_tools = text.replace(
        "import gymnasium\n", "import gymnasium\nfrom my_env.tools import X\n", 1
    )
    changes = (
        text.replace("WET, REACHED, STEP = 0.3,", "WET, REACHED, STEP = 0.31,"),
        text.replace("max_episode_steps=200", "max_episode_steps=100"),
        text.replace(
            "WET, REACHED",
            "print('noise for those who read JSON', file=__import__('sys').stderr)\nWET, REACHED",
            1,
        ),
        with_tools,
    )
    (tmp_path / "my_env").mkdir()
    (tmp_path / "my_env" / "__init__.py").write_text(
        "from my_env import puddle\n", encoding="utf-8"
    )
    (tmp_path / "my_env" / "tools.py").write_text("X = 1\n", encoding="utf-8")
    (tmp_path / "spec.yaml").write_text(
        SPEC.format(line="tasks: [goal1, my_env:Puddle-v0]\noperating_points: chosen"),
        encoding="utf-8",
    )
    asked = [{"puddle.py": each} for each in (text, "# a comment\n" + text, *changes)]
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", PLAN],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=False,
        input=json.dumps([*asked, {"tools.py": "X = 2\n"}]),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    before, commented, *after, tools = json.loads(done.stdout)
    own = {label for label in before if label.startswith("my_env:Puddle-v0 ")}
    assert len(own) == len(before) / 2
    assert commented == before
    for found in after:
        assert {label for label in found if found[label] != before[label]} == own, (
            "its own nodes run again, all of them, and no other"
        )
    assert {label for label in tools if tools[label] != after[-1][label]} == own


def test_a_recorded_spec_reads_where_its_environment_is_not(tmp_path):
    (tmp_path / "spec.yaml").write_text(
        SPEC.format(line="task: puddle:Puddle-v0"), encoding="utf-8"
    )
    found, layout = load(tmp_path / "spec.yaml"), Layout(tmp_path / "results")
    run_id = new_run(layout, found, plan_against(lay_out(found.spec), layout))
    record = layout.run(run_id) / "spec.json"
    record.write_text(
        record.read_text(encoding="utf-8").replace("puddle:", "gone:"), encoding="utf-8"
    )
    assert asked_of(read_run(layout, run_id)).spec.tasks == ("gone:Puddle-v0",)
