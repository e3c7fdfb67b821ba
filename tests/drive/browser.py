"""A real Chromium for tests, through its debugging protocol: press keys, look at the page, note
every request.
"""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

CHROMIUM = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)


class Tab:
    """One page."""

    def __init__(self, address: str) -> None:
        self._open = ExitStack()
        self._socket = self._open.enter_context(
            connect(address, max_size=None, compression=None, open_timeout=300, ping_interval=None)
        )
        self._number = 0
        self.events: list[dict[str, Any]] = []
        self.call("Network.enable")
        self.call("Page.enable")
        self.call("Runtime.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Ask the browser for something, and return its answer."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=300))
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            self.events.append(message)

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)
        self.until("location.href !== 'about:blank' && document.readyState === 'complete'")

    def value(self, expression: str) -> Any:
        """Evaluate JavaScript on the page."""
        found = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, expression: str, seconds: float = 300.0) -> Any:
        """Wait until an expression is true, and return it."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                if found := self.value(expression):
                    return found
            except AssertionError as error:  # it was asked just as one page made way for the next
                if "navigated" not in str(error):
                    raise
            time.sleep(0.03)
        raise AssertionError(
            f"never true: {expression}; the page says: {self.value('document.body.innerText')}"
        )

    def key(self, down: bool, code: str) -> None:
        self.call(
            "Input.dispatchKeyEvent", type="keyDown" if down else "keyUp", code=code, key=code
        )

    def click(self, text: str) -> None:
        """Press the button that says this."""
        found = (
            "[...document.querySelectorAll('button')].find(b => b.textContent === "
            f"{json.dumps(text)} && b.offsetParent !== null)"
        )
        self.until(f"Boolean({found})")
        self.value(f"{found}.click()")

    def size(self, width: int, height: int) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def picture(self, path: Path) -> None:
        path.write_bytes(
            base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        )

    def requests(self) -> list[str]:
        """Return the address of everything that the page has asked for."""
        self.value("1")
        sent = [
            event["params"]
            for event in self.events
            if event.get("method") == "Network.requestWillBeSent"
        ]
        sockets = [
            event["params"]
            for event in self.events
            if event.get("method") == "Network.webSocketCreated"
        ]
        return [event["request"]["url"] for event in sent] + [event["url"] for event in sockets]

    def close(self) -> None:
        self._open.close()


class Browser:
    """A headless Chromium with a folder of its own."""

    def __init__(self, port: int) -> None:
        self._port = port

    def tab(self) -> Tab:
        from urllib.request import Request, urlopen

        with urlopen(
            Request(f"http://127.0.0.1:{self._port}/json/new?about:blank", method="PUT"),
            timeout=300,
        ) as answer:
            return Tab(json.load(answer)["webSocketDebuggerUrl"])


@contextmanager
def chromium(folder: Path) -> Iterator[Browser]:
    """Run a Chromium."""
    assert CHROMIUM is not None
    options = [
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--remote-debugging-port=0",
        f"--user-data-dir={folder}",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-background-timer-throttling",
        "--disable-dev-shm-usage",
        "about:blank",
    ]
    process = subprocess.Popen(
        [CHROMIUM, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        found = folder / "DevToolsActivePort"
        end = time.monotonic() + 300
        while not (found.exists() and found.read_text().count("\n")) and time.monotonic() < end:
            time.sleep(0.05)
        yield Browser(int(found.read_text().splitlines()[0]))
    finally:
        process.kill()
        process.wait()
