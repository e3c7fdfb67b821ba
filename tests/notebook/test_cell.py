"""A cell of `wasp_cli.results` played again."""

from pathlib import Path

import numpy as np
import pytest

import wasp_cli
from tests.video.replayed import CELL, made_store
from wasp_cli.errors import UsageError


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_store(tmp_path_factory.mktemp("replay"))


def test_an_episode_has_its_frames(results: Path) -> None:
    cell = wasp_cli.results(results).cell("race1 s0 wasp noisy=0.4")
    assert cell.key == CELL == cell.manifest["key"]
    frames = list(cell.replay(episode=1, every=10))
    assert {(frame.shape, frame.dtype) for frame in frames} == {((704, 976, 3), np.dtype(np.uint8))}
    decisions = cell.episodes()["decisions"][1].as_py()
    assert len(frames) == len({*range(0, decisions, 10), decisions - 1})
    assert len({frame.tobytes() for frame in frames}) == len(frames)


def test_an_episode_that_is_not_there_is_refused(results: Path) -> None:
    with pytest.raises(UsageError, match="episode 7"):
        next(wasp_cli.results(results).cell(CELL[:6]).replay(episode=7))
