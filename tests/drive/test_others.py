"""An environment of somebody else's, driven by the scripted driver through the real socket."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.commands import wasp
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import cell_file, read_steps

pytestmark = pytest.mark.slow  # it is trained, and driven in real time

SPEC = """\
name: people
preset: smoke
tasks:
  - id: Pendulum-v1
    name: swing
    image: none
    cost: terminated
    limit: 40
    action_repeat: 2
    controls: [up]
methods: [human, wasp]
operators: {person: {p3: 3}}
operating_points: given
side_by_side: 1
seeds: [0]
episodes: 1
expert: {interactions: 400, envs: 4, evaluation_episodes: 2}
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("people")
    (folder / "people.yaml").write_text(SPEC, encoding="utf-8")
    return folder


def test_a_world_of_vectors_with_one_number_is_driven_reported_and_replayed(home):
    done = wasp(home, "drive", "people.yaml", "--simulate", "--speed", "4", "--json", code=0)
    assert len(json.loads(done.stdout)["blocks"]) == 2
    layout = Layout(home / "results")
    commands = []
    for key in stored_keys(layout, "evaluate"):
        if read_manifest(layout, "evaluate", key)["axes"]["operator"] == "person":
            steps = read_steps(cell_file(layout.artifact("evaluate", key)))
            commands.append(np.array(steps["a_h"].to_pylist()))
    assert [command.shape for command in commands] == [(20, 1), (20, 1)]
    assert max(command.max() for command in commands) == 1.0, "the script holds the key that is up"
    cell = "swing s0 wasp person=3"
    wasp(home, "replay", cell, "--episode", "0", "--out", "drive.gif", code=0)
    with Image.open(home / "drive.gif") as film:
        assert film.n_frames == 20
    assert "20 decisions" in wasp(home, "explain", cell, "--episode", "0", code=0).stdout
