"""`wasp publish --archive DIR`: a folder for a hub, from whose path alone everything loads."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.commands import ROOT
from tests.export.stored import corrected
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.export.hub import require_archive, write_archive
from wasp_cli.learning.configs import ReturnsConfig
from wasp_cli.metrics.episode import episode_metrics
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.schema import CellIdentity, Thresholds
from wasp_cli.store.tables import write_cell

NEEDS = ("world_model", "policies", "ida_q", "calibration")
LABEL = "goal1 s1 ida"
USES = """
import sys
import wasp_cli
assistant = wasp_cli.load_assistant(sys.argv[1], sys.argv[2])
model = wasp_cli.load_world_model(sys.argv[3])
places = {part.parents[2] for part in assistant.parts.inputs.values()}
print(assistant.label, model.label, model.action_size, len(places))
"""


@pytest.fixture
def published(artifacts: Mapping[str, Path], tmp_path: Path) -> Layout:
    """A store with one evaluated assistant of tiny models."""
    layout = Layout(tmp_path / "published")
    layout.prepare()
    settings = {"action_repeat": 4, "returns": ReturnsConfig().model_dump(mode="json")}
    shared = {"task": "goal1", "seed": 1, "settings": settings, "provenance": {}, "summary": {}}
    keys = {kind: f"{place}a".ljust(20, "b") for place, kind in enumerate(NEEDS)}
    for kind, key in keys.items():
        staging = staging_folder(layout, key)
        shutil.copytree(artifacts[kind], staging, dirs_exist_ok=True)
        label = f"goal1 s1 {kind}"
        commit(layout, kind, key, staging, {**shared, "kind": kind, "key": key, "label": label})
    driven = [corrected(4), corrected(3)]
    metrics = [episode_metrics(each, 1, 25.0, lambda action: action) for each in driven]
    key = "e".ljust(20, "c")
    staging = staging_folder(layout, key)
    identity = CellIdentity("goal1", "ida", "full", "laggy", 0.7, 1)
    write_cell(staging, identity, driven, metrics, Thresholds(), [[1.0] * 4, [1.0] * 3], [1, 2])
    axes = {"method": "ida", "method_config": {}, "operator": "laggy", "value": 0.7}
    manifest = {
        **shared,
        "kind": "evaluate",
        "key": key,
        "label": f"{LABEL} laggy=0.7",
        "axes": axes,
        "upstream": keys,
        "upstream_kinds": {kind: kind for kind in keys},
    }
    commit(layout, "evaluate", key, staging, manifest)
    return layout


def test_an_assistant_and_a_world_model_load_from_a_folder_that_was_moved_elsewhere(
    published: Layout, tmp_path: Path
) -> None:
    write_archive(published, "mine", tmp_path / "mine")
    moved = tmp_path / "on another machine" / "downloaded"
    moved.parent.mkdir()
    shutil.move(tmp_path / "mine", moved)
    shutil.rmtree(published.root)
    config = json.loads((moved / "config.json").read_text())
    name = config["assistants"][0]["name"]
    model = config["world_models"][0]["folder"]
    done = subprocess.run(
        [sys.executable, "-P", "-c", USES, moved, name, moved / model],
        cwd=moved.parent,
        env={"PYTHONPATH": str(ROOT), "PATH": "", "HOME": str(tmp_path), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split("\n")[0] == "goal1 s1 ida goal1 s1 world_model 2 1", done.stderr


def test_the_card_says_what_to_expect_and_how_to_upload(published: Layout, tmp_path: Path) -> None:
    count = write_archive(published, "mine", tmp_path / "mine")
    files = [path for path in (tmp_path / "mine").rglob("*") if path.is_file()]
    assert len(files) == count
    assert any(path.suffix == ".safetensors" for path in files)
    card = (tmp_path / "mine/README.md").read_text()
    config = json.loads((tmp_path / "mine/config.json").read_text())
    (assistant,) = config["assistants"]
    assert assistant["name"] == LABEL
    expected = assistant["expected"]
    assert (expected["cells"], expected["episodes"]) == (1, 2)
    row = re.search(rf"\| `{LABEL}` \| 1 \| 2 \| (\S+) \| (\S+) \| (\S+) \|", card)
    assert row is not None
    for text, which in zip(row.groups(), ("return", "cost", "int_rate"), strict=True):
        assert float(text) == pytest.approx(expected[which], abs=0.006)
    assert "hf upload USER/NAME mine ." in card
    for needed, folder in assistant["models"].items():
        assert (tmp_path / "mine" / folder / "_manifest.json").is_file(), needed
    sums = (tmp_path / "mine/SHA256SUMS").read_text()
    done = subprocess.run(
        ["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=tmp_path / "mine", check=False
    )
    assert done.returncode == 0
    assert "README.md" in sums


def test_what_lies_in_the_place_of_a_folder_stays(published: Layout, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    require_archive(tmp_path / "mine")
    (tmp_path / "mine/thesis.tex").write_text("all of it")
    for name in ("mine", "mine.zip", "missing/mine"):
        with pytest.raises(UsageError):
            require_archive(tmp_path / name)
    with pytest.raises(StoreError):
        write_archive(Layout(tmp_path / "none"), "mine", tmp_path / "other")
    assert not (tmp_path / "other").exists()
    assert (tmp_path / "mine/thesis.tex").read_text() == "all of it"
