"""`wasp_cli.load_world_model`: the published one filters as the closed loop does, and what it
imagines has the asked shapes.
"""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import wasp_cli
from wasp_cli.errors import ArtifactError, TaskError, UnknownName, UsageError
from wasp_cli.learning.closed_loop import Filter
from wasp_cli.models.base import Latent
from wasp_cli.notebook.world_model import LoadedWorldModel
from wasp_cli.store.artifact import invalidate
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.make import make_task

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "results" / "published"
QUICK = "f6cb21a6"  # that of the quickstart


@pytest.fixture(scope="module")
def model() -> LoadedWorldModel:
    return wasp_cli.load_world_model(QUICK, results=PUBLISHED)


@pytest.fixture(scope="module")
def episode(model: LoadedWorldModel) -> tuple[np.ndarray, np.ndarray, torch.Tensor]:
    """Eight images of a drive, the seven actions between them, and the closed loop's latents."""
    task = make_task("goal1", 1, action_repeat=4, observe=("pixels",))
    actions = np.random.default_rng(0).uniform(-1, 1, (7, 2)).astype(np.float32)
    seen, closed = task.reset([5]), Filter(model.module, 1)
    images, latents = [], []
    for t in range(8):
        images.append(seen.pixels[0].copy())
        with torch.inference_mode():
            latents.append(closed.see(seen, torch.tensor([float(t == 0)])).features[0])
        if t < 7:
            closed.executed(torch.from_numpy(actions[t : t + 1]))
            seen = task.step(actions[t : t + 1]).observation
    return np.array(images), actions, torch.stack(latents)


def test_it_filters_as_the_closed_loop_does(
    model: LoadedWorldModel, episode: tuple[np.ndarray, np.ndarray, torch.Tensor]
) -> None:
    images, actions, expected = episode
    latents = model.filter(images, actions)
    assert latents.shape == (8,) == (len(latents),)
    assert (latents.features == expected.numpy()).all()
    assert (model.filter(images[:1], actions[:0]).features == expected[:1].numpy()).all()


def test_it_decodes_what_was_seen(
    model: LoadedWorldModel, episode: tuple[np.ndarray, np.ndarray, torch.Tensor]
) -> None:
    images, actions, _ = episode
    latents = model.filter(images, actions)
    decoded = model.decode(latents)
    assert (decoded.shape, decoded.dtype) == (images.shape, np.dtype(np.uint8))
    with torch.inference_mode():
        direct = model.module.decode(Latent(latents.h, latents.z)).numpy()
    assert np.abs(decoded - direct * 255).max() <= 0.5 + 1e-4
    mean = model.module.mean_image.numpy() * 255
    error, guess = (np.square(picture - images.astype(float)).mean() for picture in (decoded, mean))
    assert error < 0.8 * guess, "hardly better than the mean image"


def test_it_imagines_any_leading_dimensions(
    model: LoadedWorldModel, episode: tuple[np.ndarray, np.ndarray, torch.Tensor]
) -> None:
    images, actions, _ = episode
    latents = model.filter(images, actions)
    one = model.imagine(latents[3], actions[:4])
    assert one.shape == (4,)
    assert model.decode(one).shape == (4, 6, 64, 64)
    assert model.reward(one).shape == model.cost(one).shape == (4,)
    assert (model.imagine(latents[3], actions[:4]).features == one.features).all()
    assert not (model.imagine(latents[3], actions[:4], seed=1).features == one.features).all()
    many = model.imagine(latents[3], np.repeat(actions[None, :4], 5, 0))
    assert many.shape == (5, 4)
    assert not (many.features[0] == many.features[1]).all()
    assert model.imagine(latents, np.repeat(actions[None, :2], 8, 0)).shape == (8, 2)
    grid = model.imagine(latents, np.broadcast_to(actions[:2], (3, 8, 2, 2)))
    assert grid.shape == (3, 8, 2)
    assert grid[1, 2].shape == (2,)
    assert model.reward(grid[..., -1]).shape == (3, 8)
    assert len(grid[0]) == 8
    with pytest.raises(IndexError):
        latents[3, 0]
    assert ((model.cost(grid) >= 0) & (model.cost(grid) <= 1)).all()


def test_imagined_steps_are_those_of_the_model(
    model: LoadedWorldModel, episode: tuple[np.ndarray, np.ndarray, torch.Tensor]
) -> None:
    """The deterministic part after one step depends on no draw."""
    images, actions, _ = episode
    start = model.filter(images, actions)[3]
    with torch.inference_mode():
        expected = model.module.rssm.recur(
            Latent(start.h[None], start.z[None]), torch.from_numpy(actions[:1])
        )
    assert torch.equal(model.imagine(start, actions[:1]).h, expected)


def test_other_shapes_are_refused(
    model: LoadedWorldModel, episode: tuple[np.ndarray, np.ndarray, torch.Tensor]
) -> None:
    images, actions, _ = episode
    for wrong in (images.astype(np.float32), np.moveaxis(images, 1, -1), images[0], images[:0]):
        with pytest.raises(TaskError, match=r"uint8 \[T, 6, 64, 64\]"):
            model.filter(wrong, actions)
    with pytest.raises(TaskError, match="8 observations need 7 actions"):
        model.filter(images, actions[:3])
    for odd in (actions[:, :1], actions * np.nan, [[0.0, 0.0], [0.0]]):
        with pytest.raises(TaskError, match="finite"):
            model.filter(images, odd)
    latents = model.filter(images, actions)
    with pytest.raises(TaskError, match="K of at least 1"):
        model.imagine(latents[0], actions[0])
    with pytest.raises(TaskError, match="do not fit each other"):
        model.imagine(latents, np.zeros((3, 2, 2)))


def test_it_is_found_by_folder_label_and_key(model: LoadedWorldModel, tmp_path: Path) -> None:
    key = str(model.manifest["key"])
    folder = PUBLISHED / "store" / "world_model" / key
    assert wasp_cli.load_world_model(folder).manifest["key"] == key
    assert wasp_cli.load_world_model(key[:8], results=PUBLISHED).manifest["key"] == key
    shutil.copytree(folder, tmp_path / "store" / "world_model" / key)
    assert (
        wasp_cli.load_world_model("goal1 s1 world_model", results=tmp_path).manifest["key"] == key
    )


def test_what_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="has no world model"):
        wasp_cli.load_world_model(tmp_path)
    with pytest.raises(UsageError, match="is no world model"):
        wasp_cli.load_world_model(next(PUBLISHED.glob("store/critics/*")).name, results=PUBLISHED)
    with pytest.raises(UnknownName, match="goal1 s7 world_model"):
        wasp_cli.load_world_model("goal1 s7 world_model", results=PUBLISHED)


def test_changed_bytes_are_not_loaded(tmp_path: Path, model: LoadedWorldModel) -> None:
    key = str(model.manifest["key"])
    copy = shutil.copytree(
        PUBLISHED / "store" / "world_model" / key, tmp_path / "store" / "world_model" / key
    )
    weights = copy / "world_model.safetensors"
    changed = bytearray(weights.read_bytes())
    changed[-1] ^= 1
    weights.write_bytes(changed)
    for folder in (tmp_path, copy):
        with pytest.raises(ArtifactError, match="other bytes"):
            wasp_cli.load_world_model(folder)
    with pytest.raises(ArtifactError, match="other bytes"):
        wasp_cli.load_world_model(results=tmp_path)
    invalidate(Layout(tmp_path), "world_model", copy.name, "its bytes")
    with pytest.raises(ArtifactError, match="taken out of use"):
        wasp_cli.load_world_model(copy)
    (copy / "_manifest.json").write_text('{"files": []}')
    with pytest.raises(ArtifactError, match="does not list the files"):
        wasp_cli.load_world_model(copy)


@pytest.mark.slow
def test_the_example_runs() -> None:
    done = subprocess.run(
        [sys.executable, "docs/examples/world_model.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if line.startswith("+")]
    assert len(lines) == 4
    assert "cost 1;" in lines[1], "in this world that way leads through a hazard"
