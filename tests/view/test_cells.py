"""The table of a store that grows and is noted on, and two cells beside each other."""

import io
import json
import os
import shutil
import time
from pathlib import Path
from threading import Thread
from urllib.parse import quote

import numpy as np
import pytest
from PIL import Image

from tests.commands import run_here
from tests.drive.browser import Browser
from tests.run.harness import wait_until
from tests.store.untrusted import UntrustedStore
from tests.video.replayed import CELL, made_store
from tests.view.conftest import brought, viewed
from tests.view.test_server import ask
from tests.view.test_walk import HUMAN, WASP
from wasp_cli.errors import ArtifactError, UsageError
from wasp_cli.report.explain.episode import read_episode
from wasp_cli.store.find import find_cell
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held
from wasp_cli.video.film import film
from wasp_cli.video.frame import HEIGHT, WIDTH
from wasp_cli.view.cells import FRESH
from wasp_cli.view.films import BRANCHES, FILM, REPLAY, SIZE, Films, draw, frame_name
from wasp_cli.view.pages import first_difference
from wasp_cli.view.server import ViewServer


def numbers(server: ViewServer) -> dict[str, list[str]]:
    """What the table says of every cell, once it has read them."""
    ask(server, "/cells")
    wait_until(lambda: not json.loads(ask(server, "/cells/numbers")[2])["left"])
    return dict(json.loads(ask(server, "/cells/numbers")[2])["numbers"])


def test_a_cell_that_is_computed_meanwhile_appears(tmp_path: Path) -> None:
    it = UntrustedStore(tmp_path)
    folder = it.layout.artifact("evaluate", it.key)
    folder.rename(tmp_path / "later")
    with viewed(it.layout.root) as server:
        (texts,) = numbers(server).values()
        assert texts[0] == ""
        assert texts[-1] == "not computed yet"
        assert ask(server, f"/cell/{it.key}")[0] == 409
        shutil.copytree(tmp_path / "later", folder)
        (texts,) = numbers(server).values()
        assert texts[0] == "1"
        assert texts[-1] == ""
        status, _, body = ask(server, f"/cell/{it.key}")
        assert status == 200
        assert "<h2>1 episode</h2>" in body


def test_what_is_noted_with_the_command_changes_the_numbers_of_the_page(tmp_path: Path) -> None:
    results = brought(tmp_path / "results", WASP, HUMAN)
    with viewed(results) as server:
        before = numbers(server)
        key = next(cell.key for cell in server.site.cells.listed() if cell.label == HUMAN)
        assert (
            run_here(
                "note", HUMAN, "odd", "-e", "2", "--invalid", "--results", results, columns=200
            ).exit_code
            == 0
        )
        after = numbers(server)
        assert (before[key][0], after[key][0]) == ("30", "29")
        assert before[key] != after[key]
        assert (before[key][-1], after[key][-1]) == ("", "has invalid episodes")
        assert {other: texts for other, texts in before.items() if other != key} == {
            o: texts for o, texts in after.items() if o != key
        }
        assert 'class="invalid"' in ask(server, f"/cell/{key}")[2]
        assert (
            run_here("note", HUMAN, "all", "--invalid", "--results", results, columns=200).exit_code
            == 0
        )
        assert numbers(server)[key][-1].startswith("marked as invalid by ")
        for mark in (("-e", "2"), ()):
            assert (
                run_here(
                    "note", HUMAN, "", *mark, "--valid", "--results", results, columns=200
                ).exit_code
                == 0
            )
        assert numbers(server) == before


def test_a_cell_that_comes_to_a_folder_without_runs_is_listed(tmp_path: Path) -> None:
    results = brought(tmp_path / "results", WASP)
    with viewed(results) as server:
        assert len(numbers(server)) == 1
        brought(results, HUMAN)
        time.sleep(FRESH + 0.1)
        assert len(numbers(server)) == 2


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return brought(tmp_path_factory.mktemp("view") / "results", WASP, HUMAN)


def test_the_page_says_where_two_cells_differ(results: Path) -> None:
    layout = Layout(results)
    wasp, human = (read_episode(find_cell(layout, label), 0) for label in (WASP, HUMAN))
    place = f"/compare/cells?a={quote(WASP)}&b={quote(HUMAN)}"
    with viewed(results) as server:
        _, _, body = ask(server, place)
        assert "<h2>30 worlds that both met</h2>" in body
        _, _, body = ask(server, f"{place}&world={wasp.row['episode_seed']}")
        assert f"Decision {first_difference(wasp, human)} is the first that differs." in body
        _, _, body = ask(
            server,
            f"/compare/cells?a={quote(WASP)}&b={quote(WASP)}&world={wasp.row['episode_seed']}",
        )
        assert "Both are the same, decision by decision." in body
        for wrong in (
            "",
            f"?a={quote(WASP)}",
            f"?a={quote(WASP)}&b=zzz",
            f"?a={quote(WASP)}&b={quote(HUMAN)}&world=1",
        ):
            assert ask(server, f"/compare/cells{wrong}")[0] == 404
        assert "world=&#x27;x&#x27; is no number" in ask(server, f"{place}&world=x")[2].replace(
            "&#39;", "&#x27;"
        )


@pytest.mark.slow
def test_two_cells_on_the_same_world(browser: Browser, results: Path) -> None:
    layout = Layout(results)
    wasp, human = (read_episode(find_cell(layout, label), 0) for label in (WASP, HUMAN))
    world = wasp.row["episode_seed"]
    assert human.row["episode_seed"] == world
    # Both are driven alike until WASP corrects for the first time.
    first = int(np.flatnonzero((wasp.a != human.a).any(1))[0])
    with viewed(results) as server:
        tab = browser.tab()
        tab.open(server.opening(f"/compare/cells?a={quote(WASP)}&b={quote(HUMAN)}"))
        tab.value(
            f"[...document.querySelectorAll('td a')].find(a => a.textContent === '{world}').click()"
        )
        tab.until(
            "document.querySelectorAll('section.episode').length === 2 && "
            "document.readyState === 'complete'"
        )
        assert tab.value("document.querySelector('#differs').textContent").startswith(
            f"Decision {first} "
        )
        # The page that is left stands at this step already: what comes next is for the one that is
        # opened.
        tab.value("window.left = true; document.querySelector('#differs').click()")
        tab.until(
            f"window.left === undefined && location.search.includes('step={first}') && "
            "document.readyState === 'complete'"
        )
        tab.until(
            "[...document.querySelectorAll('.step')].every(part => part.dataset.shown === "
            f"'{first}')"
        )
        # One scrubber moves both.
        tab.call("Input.dispatchKeyEvent", type="keyDown", key="ArrowRight", code="ArrowRight")
        tab.until(
            "[...document.querySelectorAll('.step')].every(part => part.dataset.shown === "
            f"'{first + 1}')"
        )
        tab.until(
            "[...document.querySelectorAll('.screen img')].every(image => image.naturalWidth > 0)"
        )
        tab.close()


# Films on demand: what is drawn is kept, bounded, and never of a module that results name.


EPISODE = 1


@pytest.fixture(scope="module")
def layout(tmp_path_factory: pytest.TempPathFactory) -> Layout:
    """Of one whole cell of 25 decisions, with its tiny models."""
    return Layout(made_store(tmp_path_factory.mktemp("films")))


def drawn(films: Films) -> set[str]:
    return {path.name for path in films.folder.iterdir() if path.is_dir()}


def test_two_servers_that_are_asked_for_one_film_at_once_draw_it_once(tmp_path: Path) -> None:
    here, there = Films(Layout(tmp_path)), Films(Layout(tmp_path))
    with held(here.folder / "lock", lambda: True):
        asked = Thread(target=there.ask, args=("0" * 20, EPISODE, FILM))
        asked.start()
        asked.join(0.5)
        assert asked.is_alive()
        assert not drawn(here)
    asked.join()
    there.close()


def shown(image: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(image)).convert("RGB"), float)


@pytest.mark.slow
def test_a_film_is_that_of_video_a_frame_for_every_decision_and_is_kept(layout: Layout) -> None:
    films, stored = Films(layout), read_episode(find_cell(layout, CELL), EPISODE)
    wait_until(lambda: films.ask(CELL, EPISODE, FILM)["state"] != "drawing")
    state = films.ask(CELL, EPISODE, FILM)
    assert (state["state"], state["frames"], state["ready"], state["every"]) == (
        "done",
        stored.decisions + 1,
        stored.decisions + 1,
        1,
    )
    assert {"robot", "command", "executed", "cost"} <= {name for name, _, _ in state["legend"]}
    seed, rewards = int(stored.row["episode_seed"]), stored.numbers["reward"]
    inner = slice(12, SIZE - 12)  # the edge says whether it has cost since the frame before
    for moment in film(
        "race1", stored.constants.action_repeat or 0, seed, stored.a, stored.a_h, rewards, 12, SIZE
    ):
        drawn = shown(films.frame(CELL, EPISODE, FILM, moment.decision) or b"")
        assert np.abs(drawn[inner, inner] - moment.frame[inner, inner]).mean() < 6, (
            "but for what compression costs"
        )
    before = {path: path.stat().st_mtime_ns for path in films.folder.rglob("*")}
    assert Films(layout).ask(CELL, EPISODE, FILM)["state"] == "done", "another server finds it"
    assert {path: path.stat().st_mtime_ns for path in films.folder.rglob("*")} == before
    for wrong in (("../../etc", 0, FILM), (CELL, 0, "../film")):
        with pytest.raises(UsageError):
            films.ask(*wrong)
    assert films.frame(CELL, EPISODE, FILM, 10**6) is None
    films.close()


@pytest.mark.slow
def test_imagined_futures_and_both_branches_are_those_of_replay(
    layout: Layout, tmp_path: Path
) -> None:
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
    assert drawn(films) == {"new", "old", f"{CELL}-0-film"}
    (films.folder / f"{CELL}-0-film" / "99999.webp").write_bytes(b"drawn")
    # of a second server: it has its own films drawn, and leaves those that are drawn as they are
    beside = Films(layout, room=1)
    assert beside.ask(CELL, 0, FILM)["state"] == "drawing"
    beside.ask(CELL, 1, FILM)
    assert films.frame(CELL, 0, FILM, 99999) == b"drawn"
    beside.close()
    films.close()
    assert beside.state(CELL, 0, FILM)["state"] == "absent"
    assert not drawn(films), "what was not finished goes with the server"


def test_results_that_cannot_be_written_have_films_elsewhere(tmp_path: Path) -> None:
    for name in ("outside", "results"):
        (tmp_path / name).mkdir()
    (tmp_path / "results" / ".wasp-view").symlink_to(tmp_path / "outside")
    films = Films(Layout(tmp_path / "results"))
    films.ask(CELL, 0, FILM)
    assert drawn(films) == {f"{CELL}-0-film"}
    assert not list((tmp_path / "outside").iterdir()), "a link leads nowhere"
    films.close()
    assert not films.folder.exists()
