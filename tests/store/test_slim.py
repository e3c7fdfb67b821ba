"""Smaller published copies: what is left out is said, and nothing else changes."""

from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

from tests.report.invented import invent, write_rows
from wasp_cli.models.weights import load_weights
from wasp_cli.store.artifact import file_digest
from wasp_cli.store.slim import STEPS_FILE, Slimming, slim, without_steps
from wasp_cli.store.tables import STEPS_FILE as TABLES_STEPS_FILE
from wasp_cli.store.tables import CellIdentity, read_episodes, read_steps


def cell(folder: Path, episodes: int = 4) -> Path:
    folder.mkdir()
    return write_rows(
        folder, CellIdentity("goal1", "wasp", "full", "noisy", 0.4, 0), [invent(e, 5, 0.2, 0.05, steps=7) for e in range(episodes)]
    )


def test_weights_of_half_size_load_into_the_same_module_and_say_what_was_left_out(tmp_path):
    module = torch.nn.Linear(40, 30)
    path = tmp_path / "m.safetensors"
    save_file({**module.state_dict(), "count": torch.arange(3)}, path)
    whole, size = file_digest(path), path.stat().st_size
    assert slim(tmp_path, "critics", Slimming(half=True)) == {"m.safetensors": {"left_out": "weights in half precision", "sha256": whole}}
    assert path.stat().st_size < 0.6 * size
    stored = load_file(path)
    assert torch.equal(stored.pop("count"), torch.arange(3))
    save_file(stored, path)
    other = torch.nn.Linear(40, 30)
    load_weights(other, path)
    assert other.weight.dtype == torch.float32
    assert torch.equal(other.weight, module.weight.half().float())
    assert slim(tmp_path, "critics", Slimming(half=True)) == {}


def test_steps_of_the_first_episodes_stay_and_the_rows_of_episodes_are_not_touched(tmp_path):
    assert STEPS_FILE == TABLES_STEPS_FILE
    path = cell(tmp_path / "cell")
    rows, steps = path.read_bytes(), read_steps(path)
    said = slim(tmp_path / "cell", "evaluate", Slimming(steps=1))
    assert said[STEPS_FILE]["left_out"] == "steps of all episodes but the first"
    assert path.read_bytes() == rows
    assert read_episodes([path]).num_rows == 4
    assert read_steps(path).equals(steps.slice(0, 7))
    assert without_steps({"kind": "evaluate", "slim": said})
    assert not without_steps({"kind": "evaluate"})
    assert not without_steps({"kind": "critics", "slim": {"m.safetensors": {}}})
    assert slim(tmp_path / "cell", "evaluate", Slimming(steps=1)) == {}


def test_images_of_diagnostics_are_left_out_where_that_is_asked_for_and_nothing_else(tmp_path):
    (tmp_path / "images.parquet").write_bytes(b"frames")
    (tmp_path / "diagnostics.json").write_text("{}")
    assert slim(tmp_path, "diagnostics", Slimming()) == {}
    assert slim(tmp_path, "dataset", Slimming(images=False)) == {}
    whole = file_digest(tmp_path / "images.parquet")
    assert slim(tmp_path, "diagnostics", Slimming(images=False)) == {"images.parquet": {"left_out": "images", "sha256": whole}}
    assert [path.name for path in tmp_path.iterdir()] == ["diagnostics.json"]
