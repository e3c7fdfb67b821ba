"""Data files decide results as code does: what an environment or an assistant reads is in the keys
of its own nodes, whoever opens it.
"""

import ast
import base64
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.plan.data import data_files, texts_of
from wasp_cli.plan.source import changed_since, source_hashes

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"

ENVIRONMENT = """
import pathlib
import gymnasium
from puddle import Puddle

HERE = pathlib.Path(__file__).parent
{above}

class Mapped(Puddle):
    {body}

gymnasium.register("Mapped-v0", entry_point=Mapped, max_episode_steps=200)
"""
MUJOCO = """
<mujoco>
  <compiler meshdir="parts"/>
  <include file="floor.xml"/>
  <asset><mesh name="m" file="wheel.obj"/></asset>
  <worldbody><geom type="mesh" mesh="m"/></worldbody>
</mujoco>
"""
CUBE = "\n".join(
    [f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    + ["f 1 2 4", "f 1 4 3", "f 5 7 8", "f 5 8 6", "f 1 5 6", "f 1 6 2", "f 3 4 8", "f 3 8 7"]
    + ["f 1 3 7", "f 1 7 5", "f 2 6 8", "f 2 8 4"]
)
FLOOR = '<mujoco><worldbody><geom type="plane" size="{size} 1 1"/></worldbody></mujoco>'
SPEC = """
name: data
preset: smoke
tasks: [goal1, mapped:Mapped-v0]
methods: [human{more}]
operators: {{noisy: {{mild: 0.2}}}}
seeds: [0]
"""

PLAN = """
import base64, json, sys
from pathlib import Path
from tests.plugins import forget
from wasp_cli.plan.grid import lay_out
from wasp_cli.spec.load import load
from wasp_cli.tasks.foreign import examine

sys.dont_write_bytecode = True
found = []
for files in json.load(sys.stdin):
    for name, content in files.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(base64.b64decode(content))
    for package in ("mapped", "own", "drawn"):
        forget(package)
    examine._known.clear()
    nodes = lay_out(load(Path("spec.yaml")).spec).nodes
    found.append({node.label: [node.key, node.recipe] for node in nodes})
print(json.dumps(found))
"""
Files = dict[str, bytes]
Keys = dict[str, list[str]]


def planned(folder: Path, *states: Files) -> list[Keys]:
    """Write the files of one state after the other, and plan each time.

    Returns:
        For each state, key and recipe of every node by its label.
    """
    encoded = [
        {name: base64.b64encode(content).decode() for name, content in state.items()}
        for state in states
    ]
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", PLAN],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(EXAMPLES)])},
        input=json.dumps(encoded),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: list[Keys] = json.loads(done.stdout.splitlines()[-1])
    return found


def module(above: str = "", body: str = "pass", more: str = "") -> Files:
    """The files of an environment, and of a spec that names it beside a task of ours."""
    source = ENVIRONMENT.format(above=above, body=body)
    return {"mapped.py": source.encode(), "spec.yaml": SPEC.format(more=more).encode()}


def changed(before: Keys, after: Keys, part: int = 0) -> set[str]:
    """The labels of the nodes whose key (or recipe: part 1) is another one."""
    return {label for label in before if before[label][part] != after[label][part]}


READERS = """
import ctypes, json, sqlite3
import numpy as np

PRICE = json.loads((HERE / "imported.json").read_text())["price"]
TEXT = open("relative.txt").read()
COMPUTED = open(HERE / ("comp" + "uted.txt")).read()

def reads_in_c(path):
    ctypes.CDLL(None).access(str(path).encode(), 4)
"""
MADE = """assets = ["declared"]

    def __init__(self, number=3):
        self.table = np.load(HERE / "maps" / "made.npy")
        sqlite3.connect(HERE / ("data" + "base.db")).close()
        reads_in_c(HERE / "in_c.dat")
        reads_in_c(f"{HERE}/in_c_{number}.dat")

    def reset(self, **options):
        open(HERE / ("res" + "et.bin")).close()
        open(HERE / ("lo" + "g.txt"), "a").write("an episode")
        open(HERE / ("lo" + "g.txt")).close()
        return super().reset(**options)
"""


def array(value: float) -> bytes:
    file = io.BytesIO()
    np.save(file, np.full(3, value))
    return file.getvalue()


READ = {
    "imported.json": (b'{"price": 0}', b'{"price": 10}'),
    "relative.txt": (b"a", b"b"),
    "computed.txt": (b"a", b"b"),
    "maps/made.npy": (array(0.0), array(10.0)),
    "database.db": (b"", b"SQLite format 3\0"),
    "in_c.dat": (b"a", b"b"),
    "in_c_3.dat": (b"a", b"b"),
    "reset.bin": (b"a", b"b"),
    "declared/deep/a.bin": (b"a", b"b"),
}
"""Every file that the environment reads: as it is first, and changed."""


@pytest.fixture(scope="module")
def plans(tmp_path_factory) -> dict[str, Keys]:
    """The plan with each file changed alone, by the file; `first` and `again` with none."""
    first = module(READERS, MADE) | {name: before for name, (before, _) in READ.items()}
    states = [first, {}]
    for name, (_, after) in READ.items():
        states.append({**first, name: after})
    names = ["first", "again", *READ]
    found = planned(tmp_path_factory.mktemp("readers"), *states)
    return dict(zip(names, found, strict=True))


@pytest.mark.parametrize("name", READ)
def test_a_changed_data_file_is_another_environment_whoever_opens_it(name, plans):
    own = {label for label in plans["first"] if label.startswith("mapped:")}
    for part in (0, 1):  # the key, and the recipe by which published results are found
        assert changed(plans["first"], plans[name], part) == own


def test_a_file_that_the_environment_writes_is_none_of_its_data(plans):
    assert plans["first"] == plans["again"], "it has written into log.txt meanwhile"


def test_a_model_of_mujoco_counts_with_the_files_that_it_names(tmp_path):
    made = 'def __init__(self): mujoco.MjModel.from_xml_path(str(HERE / "robot" / "model.xml"))'
    first = module("import mujoco", made) | {
        "robot/model.xml": MUJOCO.encode(),
        "robot/floor.xml": FLOOR.format(size=1).encode(),
        "robot/parts/wheel.obj": CUBE.encode(),
    }
    floor = {"robot/floor.xml": FLOOR.format(size=2).encode()}
    wheel = {"robot/parts/wheel.obj": CUBE.replace("v 0 0 0", "v -1 0 0").encode()}
    found = planned(tmp_path, first, floor, wheel)
    assert len({keys["mapped:Mapped-v0 s0 expert"][0] for keys in found}) == 3


@pytest.mark.parametrize(
    ("more", "line"), [("", "spec.yaml:4"), (', "own:Own"', "spec.yaml:5")], ids=["env", "own"]
)
def test_an_asset_that_is_not_there_is_an_error_at_the_line_of_the_spec(more, line, tmp_path):
    lacks = "assets = ['nowhere.bin']"
    own = ASSISTANT.decode().replace("class Own:", f"class Own:\n    {lacks}")
    files = module(body="pass" if more else lacks, more=more) | {"own.py": own.encode()}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    done = subprocess.run(
        [sys.executable, "-m", "wasp_cli", "plan", "spec.yaml"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(EXAMPLES)])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 3
    assert line in done.stderr
    assert "nowhere.bin" in done.stderr


ASSISTANT = b"""
import pathlib
import numpy as np
from wasp_cli.methods.base import Decision

class Own:
    def __init__(self, config, parts):
        self.table = np.load(pathlib.Path(__file__).parent / "own.npy")
    def reset(self, rows, seeds): ...
    def decide(self, latent, a_h, operator):
        return Decision(a_h)
"""


def test_a_file_of_an_own_assistant_is_in_the_key_of_its_cells_alone(tmp_path):
    first = module(more=', "own:Own"') | {"own.py": ASSISTANT, "own.npy": array(0.0)}
    before, after = planned(tmp_path, first, {"own.npy": array(1.0)})
    assert changed(before, after) == {label for label in before if "own:Own" in label} != set()


def test_a_file_that_changes_during_the_run_is_noticed_by_the_node(tmp_path):
    (tmp_path / "seen.py").write_text("NAME = 'seen.json'\n", encoding="utf-8")
    data = tmp_path / "seen.json"
    data.write_text("1", encoding="utf-8")
    sys.path.insert(0, str(tmp_path))
    try:
        hashes = source_hashes(["seen"])
        assert changed_since(hashes) == []
        data.write_text("22", encoding="utf-8")
        assert changed_since(hashes) == ["seen:seen.json"]
        data.unlink()
        assert changed_since(hashes) == ["seen:seen.json"]
    finally:
        sys.path.remove(str(tmp_path))


CAMERA = """
def draw(env):
    return (env + {shade}) % 256
"""
DRAWN = """
import gymnasium
from drawn.camera import draw
from puddle import Puddle

class Drawn(Puddle):
    metadata = Puddle.metadata | {{"image_modules": [{named}]}}
    def _seen(self):
        seen = super()._seen()
        return seen | {{"image": draw(seen["image"].astype(int)).astype("uint8")}}

gymnasium.register("Drawn-v0", entry_point=Drawn, max_episode_steps=200)
"""


@pytest.mark.parametrize(("named", "kept"), [("'drawn.camera'", {"expert"}), ("", set())])
def test_a_camera_that_only_assistants_see_is_not_in_the_key_of_the_expert(named, kept, tmp_path):
    env = DRAWN.format(named=named)
    spec = SPEC.format(more="").replace("mapped:Mapped-v0", "drawn.env:Drawn-v0")
    first = {
        "drawn/__init__.py": b"",
        "drawn/env.py": env.encode(),
        "drawn/camera.py": CAMERA.format(shade=0).encode(),
        "spec.yaml": spec.encode(),
    }
    camera = {"drawn/camera.py": CAMERA.format(shade=9).encode()}
    physics = {"drawn/env.py": f"{env}X = 1\n".encode()}
    before, after, others = planned(tmp_path, first, camera, physics)
    own = {label for label in before if label.startswith("drawn")}
    assert {label.split()[-1] for label in own - changed(before, after)} == kept
    assert changed(after, others) == own, "the module of the environment counts for all"


def found(folder: Path, source: str) -> set[str]:
    file = folder / "mod.py"
    file.write_text(source, encoding="utf-8")
    paths = data_files(ast.parse(source), file, folder)
    return {path.relative_to(folder).as_posix() for path in paths}


def test_files_are_found_by_their_names_in_the_source_and_docstrings_name_none(tmp_path):
    for name in ("a.json", "deep/er/b.npz", "c.txt", "t1.xml", "t2.xml", "x.py", ".hidden.json"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("", encoding="utf-8")
    assert found(tmp_path, "open('a.json')") == {"a.json"}
    assert found(tmp_path, "join('deep', 'er', 'b.npz')") == {"deep/er/b.npz"}
    assert found(tmp_path, "open('deep/er/b.npz')") == {"deep/er/b.npz"}
    assert found(tmp_path, "open(f'{here}/t{n}.xml')") == {"t1.xml", "t2.xml"}
    assert found(tmp_path, "glob('*.xml')") == {"t1.xml", "t2.xml"}
    assert found(tmp_path, "assets = ['deep']") == {"deep/er/b.npz"}
    assert found(tmp_path, "'''see c.txt'''\nopen('x.py'), open('.hidden.json')") == set()
    assert found(tmp_path, "open('/etc/hosts'), open('gone.json')") == set()


@given(st.text())
def test_any_text_of_a_source_is_no_obstacle(text):
    found = texts_of(ast.parse(f"x = {text!r}\ny = f'{{x}}' {text!r}\n"))
    assert found.whole <= {text}
