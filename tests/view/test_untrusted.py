"""Untrusted, damaged and hostile results in the viewer: it shows what is wrong, executes
nothing, reads nothing outside of the folder.
"""

import json
from pathlib import Path
from urllib.parse import quote

import pytest

from tests.drive.browser import Browser
from tests.run.harness import wait_until
from tests.store.attacks import ATTACKS
from tests.store.test_untrusted import ON_EVERY_FORM, SECRET, outside
from tests.store.untrusted import LABEL, RUN, UntrustedStore
from tests.view.conftest import viewed
from tests.view.test_server import ask
from wasp_cli.errors import UsageError, WaspError
from wasp_cli.report.notes import FILE
from wasp_cli.store.find import find_cell
from wasp_cli.view.films import BRANCHES, FILM, REPLAY, Films, draw
from wasp_cli.view.server import ViewServer

__all__ = ["outside"]

HOSTILE = '<img src=x onerror="window.owned=1">\'"><script>window.owned=1</script>'


def walked(server: ViewServer, key: str) -> str:
    """Everything that the pages say of a folder."""
    episode = f"/cell/{key}/episode/0"
    places = [
        "/",
        "/cells",
        "/cells/numbers",
        f"/cell/{key}",
        f"/cell/{quote(LABEL)}",
        episode,
        f"{episode}/explain?step=3",
        f"/run/{RUN}",
        f"/run/{RUN}/now",
        f"/run/{RUN}/log/{key}",
        f"/compare/cells?a={key}&b={key}&world=100",
        f"/film/{key}/0/film",
    ]
    texts = []
    for place in places:
        status, _, body = ask(server, place)
        assert status in (200, 404, 409), (place, status, body[-600:])
        texts.append(body)
    return "\n".join(texts)


@pytest.mark.parametrize(
    "name",
    [
        name if name in ON_EVERY_FORM else pytest.param(name, marks=pytest.mark.slow)
        for name in ATTACKS
    ],
)
def test_it_shows_what_is_wrong_and_goes_on(name: str, tmp_path: Path, outside: Path) -> None:
    it = UntrustedStore(tmp_path)
    ATTACKS[name](it, outside)
    try:
        with viewed(it.layout.root) as server:
            said = walked(server, it.key)
    except WaspError:
        return  # refused as a whole: a part of it is a link
    assert SECRET not in said
    assert "\x1b" not in said
    assert "Traceback" not in said


def test_hostile_words_stay_words(browser: Browser, tmp_path: Path) -> None:
    it = UntrustedStore(tmp_path)
    it.manifest(label=HOSTILE, provenance={"started_at": HOSTILE, "git": {"sha": HOSTILE}})
    plan = it.layout.run(RUN) / "plan.json"
    record = json.loads(plan.read_text(encoding="utf-8"))
    for node in record["nodes"]:
        node["label"], node["kind"] = HOSTILE, node["kind"]
    record["spec"] = HOSTILE
    for cell in record["cells"]:
        cell["severity"] = HOSTILE
    plan.write_text(json.dumps(record), encoding="utf-8")
    (it.layout.artifact("evaluate", it.key) / "_session.json").write_text(
        json.dumps({HOSTILE: HOSTILE, "who": {"name": HOSTILE}})
    )
    note = {
        "key": it.key,
        "label": HOSTILE,
        "episode": None,
        "text": HOSTILE,
        "mark": "",
        "author": HOSTILE,
        "at": HOSTILE,
    }
    (it.layout.root / FILE).write_text(json.dumps(note) + "\n", encoding="utf-8")
    with viewed(it.layout.root) as server:
        tab = browser.tab()
        for place in (
            "/",
            "/cells",
            f"/cell/{it.key}",
            f"/cell/{it.key}/episode/0?step=2",
            f"/run/{RUN}",
            f"/cell/{HOSTILE}",
        ):
            tab.open(server.opening(place))
            tab.value("new Promise(done => setTimeout(done, 200))")
            assert tab.value("window.owned === undefined"), place
            assert tab.value("document.querySelectorAll('img[src=x]').length") == 0, place
        tab.open(server.opening(f"/cell/{it.key}"))
        assert HOSTILE in tab.value("document.querySelector('.note').textContent")
        asked = tab.requests()
        tab.close()
        port = server.port
    assert all(url.startswith((f"http://127.0.0.1:{port}/", "data:")) for url in asked), asked


def test_an_episode_of_a_task_of_others_says_what_films_it(tmp_path: Path, outside: Path) -> None:
    it = UntrustedStore(tmp_path)
    it.rows(task=["evil_module:X-v0"])
    it.manifest(task="evil_module:X-v0")
    with viewed(it.layout.root) as server:
        _, _, page = ask(server, f"/cell/{it.key}/episode/0")
    assert "wasp replay" in page
    assert "--episode 0 --results" in page
    assert "film-of" not in page
    assert not (outside / "imported").exists()


def test_a_film_imports_no_module_that_a_cell_names(tmp_path: Path, outside: Path) -> None:
    it = UntrustedStore(tmp_path)
    it.rows(task=["evil_module:X-v0"])
    it.manifest(task="evil_module:X-v0")
    for kind in (REPLAY, BRANCHES):
        with pytest.raises(UsageError, match="no task of ours"):
            draw(it.layout, find_cell(it.layout, it.key), 0, kind, 0, tmp_path)
    films = Films(it.layout)
    films.ask(it.key, 0, FILM)
    wait_until(lambda: films.state(it.key, 0, FILM)["state"] != "drawing")
    state = films.state(it.key, 0, FILM)
    assert (state["state"], "no task of ours" in state["problem"]) == ("failed", True)
    films.close()
    assert not (outside / "imported").exists()
