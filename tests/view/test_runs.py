"""A live run's page follows it in a real Chromium, and what is asked there reaches the run as the commands' requests do."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path

import pytest

from tests.drive.browser import Browser
from tests.run.recorded import at, key, planned, process, write_run
from tests.view.conftest import viewed
from tests.view.test_server import ask
from wasp_cli.store.layout import Layout

RUN = "20260501-120000-small-abcd"


@pytest.fixture
def layout(tmp_path: Path) -> Layout:
    """A run of this process: of four nodes one is done, one failed, one runs."""
    layout = Layout(tmp_path / "results")
    layout.prepare()
    nodes = [planned(number, f"goal1 s{number} expert", needs=[number - 1] if number else []) for number in range(4)]
    log = layout.log(RUN, "goal1 s1 expert", key(1))
    facts = {"key": key(1), "label": "goal1 s1 expert", "message": "loss is <b>not</b> finite", "log": str(log)}
    events = [
        (0.0, "run started", {"nodes": 4, "jobs": 1, **process(os.getpid())}),
        (60.0, "done", {"key": key(0), "label": "goal1 s0 expert", "seconds": 60.0}),
        (80.0, "failed", facts),
    ]
    now = datetime.now(UTC).isoformat()
    running = {
        "label": "goal1 s2 expert",
        "kind": "expert",
        "share": 0.25,
        "text": "step 5",
        "started": now,
        "at": now,
        **process(os.getpid()),
    }
    write_run(layout, RUN, nodes, events, {2: running})
    log.write_text("line one\n<script>alert(1)</script>\n\x1b]0;owned\x07\n", encoding="utf-8")
    return layout


def test_a_live_run_is_followed(browser: Browser, layout: Layout) -> None:
    with viewed(layout.root) as server:
        tab = browser.tab()
        tab.open(server.opening("/"))
        tab.value(f"[...document.querySelectorAll('a')].find(a => a.textContent === '{RUN}').click()")
        tab.until("document.querySelector('#state') && document.querySelector('#state').textContent === 'running'")
        said = "document.querySelector('[data-follow]').innerText"
        assert tab.value("document.querySelector('#done').textContent") == "1"
        assert "loss is <b>not</b> finite" in tab.value(said), "a message is text, whatever it says"
        assert "step 5" in tab.value(said)
        assert tab.value("document.querySelectorAll('svg.graph .box').length") == 1

        # Another node ends: the page says so by itself.
        with layout.journal(RUN).open("a", encoding="utf-8") as journal:
            journal.write(json.dumps({"at": at(120.0), "event": "done", "key": key(2), "label": "goal1 s2 expert", "seconds": 9.0}) + "\n")
        tab.until("document.querySelector('#done').textContent === '2'", 5)
        assert "step 5" not in tab.value(said)

        # Pause, behind a confirmation.
        tab.value("[...document.querySelectorAll('.asks a')].find(a => a.textContent.startsWith('pause')).click()")
        tab.until("location.pathname.endsWith('/ask') && document.readyState === 'complete'")
        assert not layout.pause(RUN).exists(), "a question changes nothing"
        tab.click("pause")
        tab.until("!location.pathname.endsWith('/ask') && !!document.querySelector('#state')")
        assert layout.pause(RUN).exists()
        assert "paused" in tab.value(said)
        tab.value("[...document.querySelectorAll('.asks a')].find(a => a.textContent.startsWith('resume')).click()")
        tab.until("location.pathname.endsWith('/ask') && document.readyState === 'complete'")
        tab.click("resume")
        tab.until("!location.pathname.endsWith('/ask') && !!document.querySelector('#state')")
        assert not layout.pause(RUN).exists()

        # The end: nothing is asked any more.
        with layout.journal(RUN).open("a", encoding="utf-8") as journal:
            journal.write(json.dumps({"at": at(130.0), "event": "run ended"}) + "\n")
        tab.until("document.querySelector('#state').textContent === 'ended'", 5)
        tab.close()


def test_a_node_is_taken_back_behind_a_confirmation(layout: Layout) -> None:
    with viewed(layout.root) as server:
        here = f"http://127.0.0.1:{server.port}"
        place = f"/run/{RUN}/ask"
        status, _, body = ask(server, f"{place}?what=cancel&node={key(2)}")
        assert status == 200
        assert "goal1 s2 expert" in body
        assert not layout.cancelled(RUN).exists()
        form = f"form={server.site.form}&what=cancel&node={key(2)}"
        assert ask(server, place, "POST", form)[0] == 403
        assert ask(server, place, "POST", f"form=guess&what=cancel&node={key(2)}", Origin=here)[0] == 404
        assert ask(server, place, "POST", form.replace("cancel", "remove"), Origin=here)[0] == 404
        assert not layout.cancelled(RUN).exists()
        assert ask(server, place, "POST", form, Origin=here)[0] == 303
        assert layout.cancel(RUN, key(2)).exists()


def test_what_was_not_needed_is_not_said_to_be_there(tmp_path: Path) -> None:
    layout = Layout(tmp_path / "results")
    layout.prepare()
    states = ("unneeded", "cached", "missing")
    write_run(layout, RUN, [planned(number, f"goal1 s{number} expert", state) for number, state in enumerate(states)], [], {})
    with viewed(layout.root) as server:
        page = ask(server, f"/run/{RUN}")[2]
        assert "<title>expert: 1 waiting, 1 cached, 1 not needed</title>" in page
        assert 'class="not needed"' not in page


def test_a_log_is_text(layout: Layout) -> None:
    with viewed(layout.root) as server:
        status, _, body = ask(server, f"/run/{RUN}/log/{key(1)}")
        assert status == 200
        assert "line one" in body
        assert "&lt;script&gt;alert(1)&lt;/script&gt;" in body
        assert "\x1b" not in body
        assert ask(server, f"/run/{RUN}/log/{key(3)}")[0] == 404
        assert ask(server, "/run/..%2f..%2fetc/log/x")[0] == 404
        assert json.loads(ask(server, f"/run/{RUN}/state")[2])["done"] == 1
