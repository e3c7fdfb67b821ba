"""How people name modules of their own, what is said where that names none, and that what is said
to be written is accepted.
"""

import json
import re
from pathlib import Path

import pytest

from tests.commands import ROOT, python

PUDDLE = (ROOT / "docs/examples/puddle.py").read_text(encoding="utf-8")
HALFWAY = (ROOT / "docs/examples/halfway.py").read_text(encoding="utf-8")
READ = """
import json, sys
from wasp_cli.spec.load import chain_of, loaded
from wasp_cli.spec.read import InvalidSpec, parse

found = []
for name in sys.argv[1:]:
    task, method = (name, "human") if "v0" in name or "Puddle" in name else ("goal1", name)
    text = f"name: x\\npreset: smoke\\ntask: '{task}'\\nmethods: ['{method}']\\nseeds: [0]\\n"
    text += "operators: {noisy: {mild: 0.2}}\\n"
    try:
        loaded(chain_of(parse(text, "x.yaml")))
        found.append(None)
    except InvalidSpec as error:
        (problem,) = error.problems
        found.append([problem.message, problem.hint])
print(json.dumps(found))
"""


def said(home: Path, names: list[str]) -> dict[str, list[str] | None]:
    """Message and hint by name; None where it is accepted. In a process of its own, since modules
    are imported once.
    """
    done = python(home, "-c", READ, *names, code=0)
    return dict(zip(names, json.loads(done.stdout.splitlines()[-1]), strict=True))


@pytest.fixture
def home(tmp_path) -> Path:
    for name in ("my_env", "code", "test", "random", "numpy", "my-env", "2d", "envs/my env"):
        path = tmp_path / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(PUDDLE.replace("puddle:", f"{path.stem}:"), encoding="utf-8")
    (tmp_path / "envs/inner.py").write_text(PUDDLE.replace("puddle:", "envs.inner:"))
    for name in ("mine", "types", "pydantic"):
        (tmp_path / f"{name}.py").write_text(HALFWAY, encoding="utf-8")
    return tmp_path


PYTHONS = "is a module of Python itself, and hides"
INSTALLED = "registers no 'Puddle-v0'"
NO_NAME = "unknown task"
MISTAKES = {
    "code:Puddle-v0": PYTHONS,
    "random:Puddle-v0": PYTHONS,
    "test:Puddle-v0": PYTHONS,
    "types:Halfway": PYTHONS,
    "numpy:Puddle-v0": INSTALLED,
    "pydantic:Halfway": "the assistant 'pydantic:Halfway' is not in",
    "my-env:Puddle-v0": NO_NAME,
    "2d:Puddle-v0": NO_NAME,
    "envs/my env.py:Puddle-v0": NO_NAME,
    "./my_env.py:Puddle-v0": NO_NAME,
    "my_env.py:Puddle-v0": NO_NAME,
    "envs/inner.py:Puddle-v0": NO_NAME,
    "/somewhere/my_env.py:Puddle-v0": NO_NAME,
    "mine.py:Halfway": "unknown method",
    "my_env:Puddle": "registers no 'Puddle'",
    "my_env:puddle-v0": "registers no 'puddle-v0'",
    "mine:halfway": "the assistant 'mine:halfway' is not in",
}


def test_what_is_said_to_be_written_is_accepted(home):
    refused = said(home, list(MISTAKES))
    proposed = []
    for name, message in MISTAKES.items():
        assert refused[name] is not None, name
        assert message in refused[name][0], name
        hint = refused[name][1]
        for old, new in re.findall(r"rename '([^']+)' to '([^']+)'", hint):
            for path in (home / old, home / "envs" / old):
                if path.exists():
                    text = path.read_text(encoding="utf-8").replace(
                        f'"{path.stem}:', f'"{new[:-3]}:'
                    )
                    (home / new).write_text(text, encoding="utf-8")
        written = re.findall(r"'([\w.]+:[\w-]+)'", hint)
        written += [
            f"{module}:{name.rpartition(':')[2]}"
            for module in re.findall(r"write '(\w+)' before the colon", hint)
        ]
        assert len(written) == 1, hint
        proposed += written
    assert said(home, proposed) == dict.fromkeys(proposed)


def test_a_module_of_python_is_not_even_imported(home):
    refused = said(home, ["antigravity:Puddle-v0", "this:Halfway"])
    assert {message for message, _ in refused.values()} == {
        "'antigravity' is a module of Python itself",
        "'this' is a module of Python itself",
    }


def test_a_module_that_is_not_there_is_looked_for_among_those_of_the_folder(home):
    refused = said(home, ["My_Env:Puddle-v0", "my_ent:Puddle-v0", "nowhere:Puddle-v0"])
    hints = [hint for _, hint in refused.values()]
    assert hints[:2] == ["did you mean the module 'my_env'?"] * 2
    assert "run in the folder that holds 'nowhere'" in hints[2]


WAITS = """
import time

import gymnasium


class Slow(gymnasium.Env):
    def __init__(self):
        time.sleep(1.0)
        raise ValueError("its simulator is not there")


gymnasium.register("Slow-v0", Slow, max_episode_steps=10)
"""
WITH_PATIENCE = """
import sys

from wasp_cli.__main__ import main
from wasp_cli.spec import names

names.PATIENCE = float(sys.argv.pop(1))
main()
"""


@pytest.mark.parametrize(("seconds", "is_told"), [("0.1", True), ("60", False)])
def test_you_are_told_which_environment_a_command_waits_for(tmp_path, seconds, is_told):
    (tmp_path / "waits.py").write_text(WAITS, encoding="utf-8")
    (tmp_path / "x.yaml").write_text("name: x\ntasks: ['waits:Slow-v0']\n", encoding="utf-8")
    done = python(tmp_path, "-c", WITH_PATIENCE, seconds, "plan", "x.yaml", code=3)
    before_the_error = done.stderr.partition("error:")[0]
    assert ("waits:Slow-v0" in before_the_error) == is_told
    assert "its simulator is not there" in done.stderr
