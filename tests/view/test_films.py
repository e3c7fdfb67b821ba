"""Films on demand: what is drawn is kept, bounded, and never of a module that results name."""

import io
import os
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.video.replayed import CELL, made_store
from wasp_cli.errors import ArtifactError, UsageError
from wasp_cli.report.explain.episode import read_episode
from wasp_cli.store.find import find_cell
from wasp_cli.store.layout import Layout
from wasp_cli.video.film import film
from wasp_cli.video.frame import HEIGHT, WIDTH
from wasp_cli.view.films import BRANCHES, FILM, REPLAY, SIZE, Films, draw, frame_name

EPISODE = 1


@pytest.fixture(scope="module")
def layout(tmp_path_factory: pytest.TempPathFactory) -> Layout:
    """Of one whole cell of 25 decisions, with its tiny models."""
    return Layout(made_store(tmp_path_factory.mktemp("films")))


def shown(image: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(image)).convert("RGB"), float)


def test_a_film_is_that_of_video_a_frame_for_every_decision_and_is_kept(layout: Layout) -> None:
    films, stored = Films(layout), read_episode(find_cell(layout, CELL), EPISODE)
    end = time.monotonic() + 600
    while (state := films.ask(CELL, EPISODE, FILM))["state"] == "drawing":
        assert time.monotonic() < end
        time.sleep(0.05)
    assert (state["state"], state["frames"], state["ready"], state["every"]) == ("done", stored.decisions + 1, stored.decisions + 1, 1)
    assert {"robot", "command", "executed", "cost"} <= {name for name, _, _ in state["legend"]}
    seed, rewards = int(stored.row["episode_seed"]), stored.numbers["reward"]
    inner = slice(12, SIZE - 12)  # the edge says whether it has cost since the frame before
    for moment in film("race1", stored.constants.action_repeat or 0, seed, stored.a, stored.a_h, rewards, 12, SIZE):
        drawn = shown(films.frame(CELL, EPISODE, FILM, moment.decision) or b"")
        assert np.abs(drawn[inner, inner] - moment.frame[inner, inner]).mean() < 6, "but for what compression costs"
    before = {path: path.stat().st_mtime_ns for path in films.folder.rglob("*")}
    assert Films(layout).ask(CELL, EPISODE, FILM)["state"] == "done", "another server finds it"
    assert {path: path.stat().st_mtime_ns for path in films.folder.rglob("*")} == before
    for wrong in (("../../etc", 0, FILM), (CELL, 0, "../film")):
        with pytest.raises(UsageError):
            films.ask(*wrong)
    assert films.frame(CELL, EPISODE, FILM, 10**6) is None
    films.close()


def test_imagined_futures_and_both_branches_are_those_of_replay(layout: Layout, tmp_path: Path) -> None:
    cell = find_cell(layout, CELL)
    stored = read_episode(cell, EPISODE)
    assert draw(layout, cell, EPISODE, REPLAY, 0, tmp_path, 12)["frames"] == 3
    assert Image.open(tmp_path / frame_name(2)).size == (WIDTH, HEIGHT)
    draw(layout, cell, EPISODE, BRANCHES, int(np.flatnonzero(stored.intervened)[0]), tmp_path)
    assert getattr(Image.open(tmp_path / frame_name(0)), "n_frames", 1) > 1, "it moves"
    (layout.store / "world_model").rename(tmp_path / "world_model")
    try:
        with pytest.raises(ArtifactError, match="world model of this cell cannot be used"):
            draw(layout, cell, EPISODE, REPLAY, 0, tmp_path)
    finally:
        (tmp_path / "world_model").rename(layout.store / "world_model")


def test_films_are_bounded_the_oldest_go_first(layout: Layout) -> None:
    films = Films(layout, room=2500)
    for age, name in enumerate(("new", "old", "older")):
        (films.folder / name).mkdir()
        (films.folder / name / "00000.webp").write_bytes(bytes(1000))
        os.utime(films.folder / name, (1e10 - age, 1e10 - age))
    films.ask(CELL, 0, FILM)
    assert {path.name for path in films.folder.iterdir()} == {"new", "old", f"{CELL}-0-film"}
    films.close()
    assert {path.name for path in films.folder.iterdir()} == {"new", "old"}, "what was not finished goes with the server"


def test_results_that_cannot_be_written_have_films_elsewhere(tmp_path: Path) -> None:
    for name in ("outside", "results"):
        (tmp_path / name).mkdir()
    (tmp_path / "results" / ".wasp-view").symlink_to(tmp_path / "outside")
    films = Films(Layout(tmp_path / "results"))
    films.ask(CELL, 0, FILM)
    assert [path.name for path in films.folder.iterdir()] == [f"{CELL}-0-film"]
    assert not list((tmp_path / "outside").iterdir()), "a link leads nowhere"
    films.close()
    assert not films.folder.exists()
