"""A cell of `wasp_cli.results` played again: the frames are those that `wasp replay` writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

import wasp_cli
from tests.commands import run_here
from tests.video.replayed import CELL, made_store
from wasp_cli.errors import UsageError


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_store(tmp_path_factory.mktemp("replay"))


def test_frames_are_those_of_wasp_replay(results: Path, tmp_path: Path) -> None:
    cell = wasp_cli.results(results).cell("race1 s0 wasp noisy=0.4")
    assert cell.key == CELL == cell.manifest["key"]
    frames = list(cell.replay(episode=1, every=10))
    assert {(frame.shape, frame.dtype) for frame in frames} == {((704, 976, 3), np.dtype(np.uint8))}
    written = run_here("replay", CELL, "-e", "1", "--every", "10", "-o", tmp_path / "film.png", "--results", results, columns=200)
    assert written.exit_code == 0, written.output
    with Image.open(tmp_path / "film.png") as film:
        stored = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    decisions = cell.episodes()["decisions"][1].as_py()
    assert len(stored) == len(frames) == len({*range(0, decisions, 10), decisions - 1})
    for index, (one, other) in enumerate(zip(stored, frames, strict=True)):
        # A film has a palette of 256 colours.
        assert np.abs(one.astype(float) - other).mean() < 2
        assert min(range(len(frames)), key=lambda i: np.abs(one.astype(float) - frames[i]).mean()) == index


def test_an_episode_that_is_not_there_is_refused(results: Path) -> None:
    with pytest.raises(UsageError, match="episode 7"):
        next(wasp_cli.results(results).cell(CELL[:6]).replay(episode=7))
