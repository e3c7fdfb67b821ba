"""Entries of `tasks` that declare an environment: how a spec reads them, and what is in a key."""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from wasp_cli.plan.grid import Grid, lay_out
from wasp_cli.spec.load import Loaded, chain_of, loaded, override
from wasp_cli.spec.model import spec_type
from wasp_cli.spec.names import RECORDED
from wasp_cli.spec.read import InvalidSpec, parse
from wasp_cli.tasks.declared import declaration_of, declare

ROOT = Path(__file__).parents[2]

SPEC = """\
name: own
preset: smoke
{tasks}
methods: [human, wasp, expert]
operators:
  noisy: {{mild: 0.2}}
seeds: [0]
"""
SWING = """\
tasks:
  - id: Pendulum-v1
    name: swing
    cost: terminated
"""


class Threefold(gymnasium.Env):
    metadata = {"render_modes": [], "render_fps": 25}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1.0, 1.0, 3)
        return self.place.copy(), {}

    def step(self, action):
        self.place = self.place + 0.1 * action
        return self.place.copy(), 0.0, False, False, {}


def read(tasks: str, *settings: str) -> Loaded:
    overrides = [override(number, text) for number, text in enumerate(settings, start=1)]
    return loaded(chain_of(parse(SPEC.format(tasks=tasks), "x.yaml")), overrides)


def problems(tasks: str) -> list[tuple[int, str]]:
    """Return line and message with hint of every mistake."""
    with pytest.raises(InvalidSpec) as caught:
        read(tasks)
    return [
        (problem.position.line, f"{problem.message} | {problem.hint}")
        for problem in caught.value.problems
    ]


def keys(grid: Grid) -> dict[str, str]:
    return {node.label: node.key for node in grid.nodes}


def test_a_spec_has_names_and_what_is_said_of_them():
    spec = read(SWING.rstrip() + "\n  - goal1\n").spec
    assert spec.tasks == ("swing", "goal1")
    assert list(spec.environments) == ["swing"]
    short = read("task:\n  id: Pendulum-v1\n  name: swing\n  cost: terminated").spec
    assert short.environments == spec.environments


def test_by_task_and_options_know_declared_names():
    spec = read(SWING + "by_task: {swing: {expert: {envs: 3}}}").spec
    assert spec.stage("expert", "swing").model_dump()["envs"] == 3
    other = read(SWING, "tasks=[{id: Pendulum-v1, name: other, cost: terminated}]").spec
    assert other.tasks == ("other",)


def test_a_recorded_spec_says_the_same():
    spec = read(SWING).spec
    declare("swing", None)
    again = spec_type().model_validate_json(
        spec.model_dump_json(), strict=True, context={RECORDED: True}
    )
    assert again == spec
    assert declaration_of("swing") == spec.environments["swing"]


@pytest.mark.parametrize(
    ("tasks", "line", "message"),
    [
        ("tasks:\n  - {id: Pendulum-v1,\n     coast: terminated}", 5, "unknown key 'coast'.*cost"),
        ("tasks:\n  - name: swing\n    cost: terminated", 4, "missing key 'id'"),
        ("tasks:\n  - id: goal1\n    cost: terminated", 4, "'goal1' is no gymnasium id.*alone"),
        ("tasks:\n  - id: Pendulum-v9\n    cost: terminated", 4, "Pendulum-v9.*Pendulum-v1"),
        ("tasks:\n  - id: Pendulum-v1\n    cost: crash", 5, "'crash' does not say.*info.NAME"),
        ("tasks:\n  - id: Pendulum-v1\n    cost: info.crash", 5, "no info.crash: info is empty"),
        ("tasks:\n  - id: Pendulum-v1\n    cost: {a: 3}", 5, "should be a string, not 3"),
        (
            "tasks:\n  - id: Pendulum-v1\n    cost: terminated\n    image: nonsense",
            6,
            "no entry 'nonsense'.*render",
        ),
        (
            "tasks:\n  - id: Pendulum-v1\n    cost: terminated\n    make: {gravity: 9}",
            6,
            "gravity.*it takes g",
        ),
        (
            "tasks:\n  - id: Pendulum-v1\n    cost: terminated\n    limit: 0",
            6,
            "greater than or equal to 1",
        ),
        ("tasks:\n  - id: CartPole-v1\n    cost: terminated", 4, "Discrete.*continuous"),
        (
            "tasks:\n  - id: Pendulum-v1\n    name: goal1\n    cost: terminated",
            5,
            "name of another task",
        ),
        (
            SWING + "  - id: Pendulum-v1\n    name: swing\n    cost: info.x",
            7,
            "another environment is called 'swing'",
        ),
        ("tasks: [Pendulum-v1]", 3, "its info has no 'cost'.*cost: info.crashed"),
        ("tasks: [goal1]\nenvironments: {}", 4, "no 'environments'"),
        (SWING + "    controls: [right, up]", 7, r"2 controls.*1 numbers.*\[right\]"),
        (SWING + "    controls: [rigt]", 7, "did you mean 'right'"),
    ],
)
def test_every_mistake_has_its_line_and_a_remedy(tasks, line, message):
    found = problems(tasks)
    assert [at for at, _ in found] == [line]
    assert re.search(message, found[0][1]), found


class Needy(gymnasium.Env):
    def __init__(self, gravity: float = 9.81):
        import a_package_that_is_not_installed  # noqa: F401


def test_a_missing_package_is_no_mistake_in_the_arguments(monkeypatch):
    registered = gymnasium.envs.registration.EnvSpec("Needy-v0", Needy, max_episode_steps=10)
    monkeypatch.setitem(gymnasium.registry, "Needy-v0", registered)
    ((line, said),) = problems(
        "tasks:\n  - id: Needy-v0\n    make: {gravity: 9}\n    cost: terminated"
    )
    assert line == 4  # of `id`, not of `make`
    assert "a_package_that_is_not_installed" in said
    assert "arguments" not in said


def test_where_people_drive_many_numbers_need_keys():
    drives = "tasks: [{id: Threefold-v0, name: three, cost: terminated%s}]"
    gymnasium.register("Threefold-v0", entry_point=Threefold, max_episode_steps=20)
    people = "operators={person: {p1: 1}}"
    with pytest.raises(InvalidSpec) as caught:
        read(drives % "", people)
    assert "its 3 numbers" in caught.value.problems[0].message
    spec = read(drives % ", controls: [up, none, right]", people).spec
    assert spec.environments["three"].controls == ("up", "none", "right")


def test_controls_are_in_no_key():
    assert keys(lay_out(read(SWING).spec)) == keys(
        lay_out(read(SWING + "    controls: [left]").spec)
    )


def test_all_mistakes_are_told_at_once():
    found = problems("tasks:\n  - {id: Pendulum-v1, coast: a}\n  - {id: Acrobot-v1, cost: info.x}")
    assert [at for at, _ in found] == [4, 5]


def test_what_is_declared_is_in_keys_and_in_what_a_worker_gets():
    grid = lay_out(read(SWING).spec)
    assert all(
        node.settings["environment"] == {"id": "Pendulum-v1", "cost": "terminated"}
        for node in grid.nodes
    )
    changed = lay_out(read(SWING + "    make: {g: 9.0}").spec)
    assert set(keys(grid).values()).isdisjoint(keys(changed).values())
    own = lay_out(read(SWING + "    action_repeat: 2").spec)
    assert {node.settings.get("action_repeat", 2) for node in own.nodes} == {2}
    assert all("action_repeat" not in node.settings["environment"] for node in own.nodes)


@pytest.mark.skipif(find_spec("pygame") is None, reason="Pendulum draws with pygame")
def test_another_image_trains_no_expert_again_that_reads_vectors():
    drawn, other = (
        keys(lay_out(read(SWING + line).spec)) for line in ("    image: render", "    image: none")
    )
    same = {label for label, key in drawn.items() if other[label] == key}
    assert same == {"swing s0 expert"}


class TwoCameras(gymnasium.Env):
    """A world with two cameras and a vector; nothing happens in it."""

    metadata = {"render_modes": [], "render_fps": 10}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    observation_space = gymnasium.spaces.Dict(
        {
            "near": gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8),
            "far": gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8),
            "place": gymnasium.spaces.Box(-1.0, 1.0, (2,)),
        }
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action):
        return self._seen(), 0.0, False, False, {}

    def _seen(self):
        black = np.zeros((8, 8, 3), np.uint8)
        return {"near": black, "far": black, "place": np.zeros(2, np.float32)}


gymnasium.register("TwoCameras-v0", entry_point=TwoCameras, max_episode_steps=20)


@pytest.mark.parametrize(
    ("said", "kept"), [("    state: [place]\n", {"cameras s0 expert"}), ("", set())]
)
def test_another_camera_trains_an_expert_again_only_where_it_learns_from_the_image(said, kept):
    entry = "tasks:\n  - id: TwoCameras-v0\n    name: cameras\n    cost: terminated\n" + said
    near, far = (
        keys(lay_out(read(f"{entry}    image: {camera}").spec)) for camera in ("near", "far")
    )
    assert {label for label, key in near.items() if far[label] == key} == kept
    assert near["cameras s0 dataset"] != far["cameras s0 dataset"]


@pytest.mark.parametrize(
    ("task", "written", "expected"),
    [
        (SWING, "", {"world_model", "policies", "expert"}),
        (SWING, "residual: {cost_limit: 25}", {"world_model", "policies"}),
        ("task: goal1", "", {"world_model", "policies"}),
    ],
)
def test_a_residual_whose_limit_follows_from_the_expert_reads_the_expert(task, written, expected):
    grid = lay_out(read(f"{task}\nstages: [residual]\n{written}").spec)
    (residual,) = (node for node in grid.nodes if node.kind == "residual")
    assert set(residual.needs) == expected


def test_nodes_of_tasks_of_which_nothing_is_said_have_no_environment():
    named = lay_out(read("tasks: [goal1]").spec)
    assert not any("environment" in node.settings for node in named.nodes)


LOUD = """
import os
import gymnasium
from gymnasium.envs.classic_control import PendulumEnv

print("hello from the module")

class Loud(PendulumEnv):
    def step(self, action):
        print("stepped")
        os.system("echo from another program")
        return super().step(action)

gymnasium.register("Loud-v0", entry_point=Loud, max_episode_steps=20)
"""


def test_what_an_environment_prints_does_not_get_into_a_plan_as_json(tmp_path):
    (tmp_path / "loud.py").write_text(LOUD, encoding="utf-8")
    tasks = "tasks:\n  - id: loud:Loud-v0\n    name: loud\n    cost: terminated"
    (tmp_path / "x.yaml").write_text(SPEC.format(tasks=tasks), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "wasp_cli", "plan", "x.yaml", "--json"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith("{")
    assert "hello" not in done.stdout
    assert "another program" in done.stderr


SINGLE = [path for path in sorted((ROOT / "specs" / "away").glob("*.yaml")) if path.stem != "away"]
"""Specs of one environment each; `away` has all of them."""


@pytest.mark.parametrize("path", SINGLE, ids=str)
def test_the_specs_of_others_environments_are_short(path):
    """At most 15 lines declare a task."""
    lines = path.read_text(encoding="utf-8").splitlines()
    begin = lines.index("tasks:") + 1
    entry = [line for line in lines[begin:] if line.startswith(" ")]
    assert 0 < len(entry) <= 15


@pytest.mark.parametrize("path", sorted((ROOT / "specs" / "away").glob("*.py")), ids=str)
def test_the_functions_of_others_environments_are_short(path):
    lines = path.read_text(encoding="utf-8").splitlines()
    code = [line for line in lines if line.strip() and not line.strip().startswith(("#", '"""'))]
    assert len(code) <= 30
