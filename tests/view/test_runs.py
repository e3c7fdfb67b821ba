"""A live run's page follows it in a real Chromium; its nodes are counted by stage, and a log is
text.
"""

import json
import os
import re
from datetime import UTC, datetime

import pytest

from tests.drive.browser import Browser
from tests.run.recorded import at, key, planned, process, write_run
from tests.view.conftest import viewed
from tests.view.test_server import ask
from wasp_cli.store.layout import Layout

RUN = "20260501-120000-small-abcd"


@pytest.fixture
def live(layout: Layout) -> Layout:
    """A run of this process: of four nodes one is done, one failed, one runs."""
    nodes = [
        planned(number, f"goal1 s{number} expert", needs=[number - 1] if number else [])
        for number in range(4)
    ]
    log = layout.log(RUN, "goal1 s1 expert", key(1))
    facts = {
        "key": key(1),
        "label": "goal1 s1 expert",
        "message": "loss is <b>not</b> finite",
        "log": str(log),
    }
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
    }
    running |= process(os.getpid())
    write_run(layout, RUN, nodes, events, {2: running})
    log.write_text("line one\n<script>alert(1)</script>\n\x1b]0;owned\x07\n", encoding="utf-8")
    return layout


def test_a_live_run_is_followed(browser: Browser, live: Layout) -> None:
    with viewed(live.root) as server:
        tab = browser.tab()
        tab.open(server.opening("/"))
        tab.value(
            f"[...document.querySelectorAll('a')].find(a => a.textContent === '{RUN}').click()"
        )
        tab.until(
            "document.querySelector('#state') && "
            "document.querySelector('#state').textContent === 'running'"
        )
        said = "document.querySelector('[data-follow]').innerText"
        assert tab.value("document.querySelector('#done').textContent") == "1"
        assert "loss is <b>not</b> finite" in tab.value(said), "a message is text, whatever it says"
        assert "step 5" in tab.value(said)
        assert (
            tab.value(
                "document.querySelectorAll('[data-follow] form, [data-follow] button').length"
            )
            == 0
        ), "nothing can be asked of it"

        tab.size(500, 900)
        assert tab.value("document.documentElement.scrollWidth") <= 500, "it fits a narrow window"

        # Another node ends: the page says so by itself.
        with live.journal(RUN).open("a", encoding="utf-8") as journal:
            journal.write(
                json.dumps(
                    {
                        "at": at(120.0),
                        "event": "done",
                        "key": key(2),
                        "label": "goal1 s2 expert",
                        "seconds": 9.0,
                    }
                )
                + "\n"
            )
        tab.until("document.querySelector('#done').textContent === '2'")
        assert "step 5" not in tab.value(said)

        # The end: it is not followed any more.
        with live.journal(RUN).open("a", encoding="utf-8") as journal:
            journal.write(json.dumps({"at": at(130.0), "event": "run ended"}) + "\n")
        tab.until("document.querySelector('#state').textContent === 'ended'")
        tab.close()


def test_nodes_are_counted_by_stage_and_what_was_not_needed_is_not_said_to_be_there(
    layout: Layout,
) -> None:
    states = ("unneeded", "cached", "missing", "missing")
    nodes = [
        planned(number, f"goal1 s{number} expert", state) for number, state in enumerate(states)
    ]
    nodes.append({**planned(4, "goal1 s3 cell", needs=[3]), "kind": "a-cell"})
    write_run(layout, RUN, nodes, [], {})
    with viewed(layout.root) as server:
        page = ask(server, f"/run/{RUN}")[2]
        heading, *rows = re.findall(r"<tr>.*?</tr>", page.partition("Nodes by stage")[2])
        names = re.findall(r"<th[^>]*>([^<]*)", heading)
        counts = [
            dict(zip(names, re.findall(r"<td[^>]*>([^<]*)", row), strict=True)) for row in rows
        ]
        said = [{name: text for name, text in row.items() if text} for row in counts]
        assert said == [
            {"Stage": "expert", "waiting": "2", "cached": "1", "not needed": "1"},
            {"Stage": "a-cell", "waiting": "1"},
        ]


def test_a_log_is_text(live: Layout) -> None:
    with viewed(live.root) as server:
        status, headers, body = ask(server, f"/run/{RUN}/log/{key(1)}")
        assert (status, headers["content-type"], headers["x-content-type-options"]) == (
            200,
            "text/plain; charset=utf-8",
            "nosniff",
        )
        assert "line one" in body
        assert "\x1b" not in body
        assert ask(server, f"/run/{RUN}/log/{key(3)}")[0] == 404
        assert ask(server, "/run/..%2f..%2fetc/log/x")[0] == 404
