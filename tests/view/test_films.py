"""Films on demand: what is drawn is kept, bounded, and never of a module that results name."""

from __future__ import annotations

import io
import os
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.video.replayed import CELL, made_store
from tests.view.conftest import brought
from tests.view.test_walk import WASP
from wasp_cli.errors import UsageError
from wasp_cli.report.explain.episode import read_episode
from wasp_cli.store.find import find_cell
from wasp_cli.store.layout import Layout
from wasp_cli.video.film import film
from wasp_cli.video.replay import replay_frames
from wasp_cli.view.films import BRANCHES, FILM, REPLAY, SIZE, Films


@pytest.fixture(scope="module")
def layout(tmp_path_factory: pytest.TempPathFactory) -> Layout:
    return Layout(brought(tmp_path_factory.mktemp("view") / "results", WASP))


def finished(films: Films, key: str, kind: str = FILM, seconds: float = 600.0) -> dict[str, object]:
    end = time.monotonic() + seconds
    films.ask(key, 0, kind)
    while (state := films.state(key, 0, kind))["state"] not in ("done", "failed"):
        assert time.monotonic() < end, state
        time.sleep(0.05)
    return state


def test_a_film_is_that_of_video_a_frame_for_every_decision(layout: Layout) -> None:
    cell = find_cell(layout, WASP)
    assert cell.key is not None
    films = Films(layout)
    state = finished(films, cell.key)
    stored = read_episode(cell, 0)
    assert (state["state"], state["frames"], state["ready"], state["every"]) == ("done", stored.decisions + 1, stored.decisions + 1, 1)
    names = [name for name, _, _ in state["legend"]]  # type: ignore[attr-defined]
    assert {"robot", "goal", "hazard", "vase", "command", "executed", "cost"} == set(names)
    seed, rewards = int(stored.row["episode_seed"]), stored.numbers["reward"]
    drawn = film("goal1", stored.constants.action_repeat or 0, seed, stored.a, stored.a_h, rewards, 50, SIZE)
    for moment in drawn:
        found = films.frame(cell.key, 0, FILM, moment.decision)
        shown = np.asarray(Image.open(io.BytesIO(found[0])).convert("RGB"), float)[:SIZE, :SIZE]
        assert np.abs(shown - moment.frame).mean() < 6, "but for what compression costs"
    before = {path: path.stat().st_mtime_ns for path in films.folder.rglob("*")}
    assert Films(layout).ask(cell.key, 0, FILM)["state"] == "done", "another server finds it"
    assert {path: path.stat().st_mtime_ns for path in films.folder.rglob("*")} == before
    films.close()


def test_what_cannot_be_drawn_says_why(tmp_path: Path) -> None:
    label = "race1 s2 wasp laggy=0.7"  # of the trainings after the first no models are published
    layout = Layout(brought(tmp_path / "results", label))
    key = find_cell(layout, label).key or ""
    films = Films(layout)
    state = finished(films, key, REPLAY)
    assert state["state"] == "failed"
    assert "world model of this cell cannot be used" in str(state["problem"])
    with pytest.raises(UsageError):
        films.ask("../../etc", 0, FILM)
    with pytest.raises(UsageError):
        films.ask(key, 0, "../film")
    assert films.frame(key, 0, FILM, 10**6) is None
    films.close()


def test_imagined_futures_and_both_branches_are_those_of_replay(tmp_path: Path) -> None:
    """Of a whole cell with its models; tiny ones."""
    layout = Layout(made_store(tmp_path))
    stored = read_episode(find_cell(layout, CELL), 1)
    step = int(np.flatnonzero(stored.intervened)[0])
    films = Films(layout)
    for kind, at in ((REPLAY, 0), (BRANCHES, step)):
        films.ask(CELL, 1, kind, at)
        end = time.monotonic() + 600
        while (state := films.state(CELL, 1, kind, at))["state"] == "drawing":
            assert time.monotonic() < end
            time.sleep(0.05)
        assert state["state"] == "done", state
        found = films.frame(CELL, 1, kind, 0, at)
        image = Image.open(io.BytesIO(found[0]))
        if kind == REPLAY:
            assert state["frames"] == stored.decisions
            expected = next(iter(replay_frames(layout, find_cell(layout, CELL), 1, 1)))
            assert np.abs(np.asarray(image.convert("RGB"), float) - expected).mean() < 6
        else:
            assert getattr(image, "n_frames", 1) > 1, "it moves"
    films.close()


def test_films_are_bounded_the_oldest_go_first(tmp_path: Path) -> None:
    results = brought(tmp_path / "results", WASP)
    films = Films(Layout(results), room=2500)
    for age, name in enumerate(("new", "old", "older")):
        (films.folder / name).mkdir()
        (films.folder / name / "00000.webp").write_bytes(bytes(1000))
        os.utime(films.folder / name, (1e9 - age, 1e9 - age))
    films.ask(find_cell(films._layout, WASP).key or "", 0, FILM)
    assert not (films.folder / "older").exists()
    assert (films.folder / "new").exists()
    assert (films.folder / "old").exists()
    films.close()
    assert not list(films.folder.glob("*-film")), "what was not finished goes with the server"


def test_results_that_cannot_be_written_have_films_elsewhere(tmp_path: Path) -> None:
    results = brought(tmp_path / "results", WASP)
    (tmp_path / "outside").mkdir()
    (results / ".wasp-view").symlink_to(tmp_path / "outside")
    films = Films(Layout(results))
    assert finished(films, find_cell(Layout(results), WASP).key or "")["state"] == "done"
    assert not list((tmp_path / "outside").iterdir()), "a link leads nowhere"
    folder = films.folder
    films.close()
    assert not folder.exists()
