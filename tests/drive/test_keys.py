"""What the page makes of pressed keys, in a JavaScript engine with just as much of a browser as its script touches."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

import wasp_cli.drive

NODE = shutil.which("node")
PAGE = Path(wasp_cli.drive.__file__).parent / "page" / "drive.js"
pytestmark = pytest.mark.skipif(NODE is None, reason="no node on this machine")

BROWSER = """
const listeners = {}, said = [];
const anything = () => new Proxy({ style: {}, classList: { toggle() {} }, firstElementChild: null, dataset: {} }, {
  get: (own, name) => (name in own ? own[name] : () => anything()), set: (own, name, value) => { own[name] = value; return true; } });
const byName = {};
globalThis.document = {
  getElementById: (id) => (byName[id] ??= anything()), createElement: anything, addEventListener() {}, hasFocus: () => true };
globalThis.location = { search: "?token=t", host: "here" };
globalThis.addEventListener = (name, does) => { listeners[name] = does; };
globalThis.requestAnimationFrame = () => {};
globalThis.setInterval = () => {};
globalThis.WebSocket = class { static OPEN = 1; constructor() { this.readyState = 1; } send(text) { said.push(JSON.parse(text)); } };
const press = (name, code, more) => listeners[name]({ code, preventDefault() {}, ...more });
const driven = () => said.filter((message) => message.type === "input").map((message) => message.keys);
"""


def page(steps: str) -> Any:
    """Run the page's script and then some steps; returns what these make of `result`."""
    assert NODE is not None
    script = f"{BROWSER}\n{PAGE.read_text()}\nlet result;\n{steps}\nconsole.log(JSON.stringify(result));"
    done = subprocess.run([NODE, "-"], input=script, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_key_that_is_held_while_go_is_pressed_drives() -> None:
    steps = """
    enter({ phase: "ready", episode: 0, of: 1 });
    press("keydown", "ArrowUp"); press("keydown", "ArrowUp", { repeat: true });
    result = { before: driven() };
    enter({ phase: "driving", episode: 0, of: 1 });
    result.after = driven();
    press("keyup", "ArrowUp");
    result.released = driven().at(-1);
    """
    assert page(steps) == {"before": [], "after": [["ArrowUp"]], "released": []}


def test_a_key_that_stays_down_after_the_window_had_lost_the_focus_drives_again() -> None:
    steps = """
    enter({ phase: "driving", episode: 0, of: 1 });
    press("keydown", "KeyW"); listeners.blur(); press("keydown", "KeyW", { repeat: true }); press("keydown", "KeyW", { repeat: true });
    result = driven();
    """
    assert page(steps) == [[], ["KeyW"], [], ["KeyW"]]
