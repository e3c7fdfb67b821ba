"""A real Chromium drives: keys as pressed, the window's focus, a broken connection, a second
tab, and no request to anybody else.
"""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from tests.drive.browser import Browser
from tests.drive.conftest import served, wanted
from tests.run.harness import wait_until
from tests.view.conftest import browser
from wasp_cli.store.layout import Layout
from wasp_cli.store.people import TIMING_FILE, read_timing
from wasp_cli.store.tables import cell_file, read_steps
from wasp_cli.tasks.goal.task import Goal

__all__ = ["browser"]


def test_an_episode_in_a_browser(
    browser: Browser, imported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Goal, "num_steps", 600)  # 150 decisions
    results = shutil.copytree(imported, tmp_path / "results")
    session = wanted(results, "wasp", 4.0).prepared()
    with served(session) as (desk, server, clock):
        tab = browser.tab()
        tab.size(1280, 800)
        tab.open(server.address)
        tab.until("phase === 'ready'")
        assert tab.value("document.querySelectorAll('#toggles input').length") == 6
        card = tab.value("byId('card').textContent")
        assert "WASP assists" in card
        assert {"your command", "what is executed", "goal", "hazard"} <= {
            *tab.value("[...document.querySelectorAll('#card span')].map((s) => s.textContent)")
        }
        tab.key(True, "ArrowDown")
        tab.click("Go")
        tab.until(
            "phase === 'driving' && frame && frame.header.t > 5 && frame.header.command[0] === -1"
        )
        tab.key(False, "ArrowDown")
        painted = "new Set(byId('map').getContext('2d').getImageData(0, 0, 480, 480).data).size"
        assert tab.value(painted) > 10, "the map is drawn"
        assert tab.value(painted.replace("map", "eyes").replace("480, 480", "64, 128")) > 10, (
            "the cameras are shown"
        )

        def comes(expected: set[str]) -> None:
            """What the page says arrives a moment later."""
            wait_until(lambda: desk.held.keys == expected)

        tab.key(True, "ArrowUp")
        comes({"ArrowUp"})
        tab.key(True, "KeyA")
        comes({"ArrowUp", "KeyA"})
        tab.until("frame.header.command[0] === 1 && frame.header.command[1] === 1")
        assert tab.value("byId('knob').style.transform") == "translate(-3rem, -3rem)", (
            "the pad shows what keys command"
        )
        tab.key(False, "ArrowUp")
        comes({"KeyA"})
        first = tab.value("frame.header.t")
        tab.until(f"frame.header.t > {first} + 3 && frame.header.command[1] === 1")

        # The window loses the focus: nothing stays held, and the world waits.
        tab.value("window.dispatchEvent(new Event('blur'))")
        comes(set())
        tab.until("phase === 'paused'")
        assert tab.value("document.activeElement.textContent") == "Go on", "Space or Enter goes on"
        tab.key(False, "KeyA")
        focus = "window.dispatchEvent(new Event('focus'))"
        tab.value(focus)

        # A gamepad that is unplugged lets go.
        for plugged, axes in (("{axes: [0, -0.5]}", (0.5, 0.0)), ("null", (0.0, 0.0))):
            tab.value(f"void (navigator.getGamepads = () => [{plugged}])")
            wait_until(lambda axes=axes: desk.held.axes == axes)

        # A second tab is told, and changes nothing.
        second = browser.tab()
        second.open(server.address)
        second.until("document.body.innerText.includes('Somebody drives already')")
        second.close()
        tab.value(focus)
        tab.click("Go on")
        tab.until("phase === 'driving'")

        # The connection breaks in the middle: the world waits, and goes on where it was.
        tab.key(True, "ArrowUp")
        comes({"ArrowUp"})
        tab.value("socket.close()")
        tab.until("phase === 'paused' && frame")  # the last one comes again
        comes(set())
        where = tab.value("frame.header.t")
        time.sleep(0.3)
        assert tab.value("frame.header.t") == where
        tab.key(False, "ArrowUp")
        tab.click("Go on")
        tab.until(f"phase === 'driving' && frame.header.t > {where} + 5")
        tab.key(True, "ArrowUp")
        tab.until("phase === 'over'")
        assert "1 of 1 episodes" in tab.value("document.body.innerText")
        # The episode beside the same commands alone, and its film.
        assert "Your commands alone: return" in tab.value("byId('card').textContent")
        tab.click("Watch it again")
        tab.until("player && player.at > 20")
        tab.value("player.begun = null; byId('scrub').value = 0")
        tab.until("player.at === 0")
        first = tab.value("byId('map').toDataURL()")
        tab.value("byId('scrub').value = 100")
        tab.until("player.at === 100")
        assert tab.value("byId('map').toDataURL()") != first
        assert tab.value("byId('progress').textContent") == "replay of the last episode"
        tab.value("replayStep = () => 400")  # ms: it still plays when a busy machine clicks
        tab.click("Play")
        tab.until("player.at > 102 && byId('on').textContent === 'Stop'")
        tab.click("Stop")
        tab.until("player.begun === null && byId('on').textContent === 'Play'")
        tab.click("Back")
        tab.value(
            "var saved = 0; URL.createObjectURL = (blob) => { saved = blob; return location.href; }"
        )
        tab.value("HTMLAnchorElement.prototype.click = () => 0")
        tab.value("replayStep = () => 8")  # ms: the film takes as long as the replay
        tab.click("Save as a film")
        tab.until("saved instanceof Blob")
        film = tab.value(
            "new Promise((read) => { const reader = new FileReader(); "
            "reader.onload = () => read(reader.result); reader.readAsDataURL(saved); })"
        )
        # it plays to its end, with several frames; an empty tab forbids no video
        screen = browser.tab()
        screen.value(
            "var video = document.createElement('video'); video.muted = true; "
            f"document.body.append(video); video.src = '{film}'; video.play(); 0"
        )
        screen.until("video.ended && video.getVideoPlaybackQuality().totalVideoFrames > 1")
        screen.close()
        # without map and numbers, and without the map
        for shown, said in (("", [0, 0]), ("return: 1, cost: 0", [1, 0])):
            assert (
                tab.value(
                    f"review = {{driven: [{{{shown}}}], alone: []}}; [compared().length, "
                    "replays().length]"
                )
                == said
            )
        asked = tab.requests()
        tab.close()
        clock.join(300)
        port = server.port
    assert all(
        url.startswith((f"http://127.0.0.1:{port}/", f"ws://127.0.0.1:{port}/", "data:"))
        for url in asked
    ), asked

    (block,) = session.done
    folder = Layout(results).artifact("evaluate", block["key"])
    beats, steps = read_timing(folder / TIMING_FILE), read_steps(cell_file(folder))
    keys, commands = beats["keys"].to_pylist(), np.array(steps["a_h"].to_pylist())
    assert {"", "ArrowDown", "ArrowUp", "KeyA", "ArrowUp KeyA"} <= set(keys), (
        "a key that is held while Go is pressed drives"
    )
    forward, back, left = (
        np.array([name in held.split() for held in keys], float)
        for name in ("ArrowUp", "ArrowDown", "KeyA")
    )
    np.testing.assert_array_equal(commands, np.stack([forward - back, left], 1))
    assert (desk.lost, desk.blurred) == (1, 1)
