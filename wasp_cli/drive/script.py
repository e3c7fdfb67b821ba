"""A scripted driver: presses the keys that lead to the goal, as a page would. For checks of the timing and for trials of a study.

It talks to the real socket, so that everything but the browser is what a person meets.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from wasp_cli import seeds
from wasp_cli.drive.desk import KEYS
from wasp_cli.drive.server import LONGEST, unpacked
from wasp_cli.errors import WaspError
from wasp_cli.tasks.frames import wrapped

AHEAD, ASIDE = 1.0, 0.25
"""Angles to the goal in rad: below the first it drives forward, above the second it turns."""
LARGEST = 4_000_000
"""Bytes of what the server sends at most: the picture of the ground is the largest."""

ATTEMPTS, PAUSE = 20, 0.5
"""Times that it tries to connect, and seconds between them. A page tries for ever."""

ARROWS = [key for key in KEYS if key.startswith("Arrow")]

Driver = Callable[[Mapping[str, Any]], list[str]]
"""From the header of a frame to the keys that are held."""


def to_the_goal(header: Mapping[str, Any]) -> list[str]:
    """Return the keys that turn and drive towards the nearest goal; without one, forward."""
    goals, robot = header.get("things", {}).get("goal"), header.get("robot")
    if not goals or robot is None:
        return ["ArrowUp"]
    x, y, yaw = robot
    goal = min(goals, key=lambda place: math.hypot(place[0] - x, place[1] - y))
    error = float(wrapped(math.atan2(goal[1] - y, goal[0] - x) - yaw))
    keys = ["ArrowUp"] if abs(error) < AHEAD else []
    if abs(error) > ASIDE:
        keys.append("ArrowLeft" if error > 0 else "ArrowRight")
    return keys


class Habits:
    """A scripted participant: to the goal, with a delay and slips of its own, and answers that are drawn.

    Habits are drawn by the participant's number. What is driven still differs a little between two trials, as the clock does.
    """

    DELAY, SLIPS, HELD = 5, 0.08, 5
    """Frames of delay at most, share of frames in which a key slips at most, frames for which a wrong one is held."""

    def __init__(self, participant: int) -> None:
        """`participant` is the number."""
        self._draw = np.random.default_rng(seeds.derive("drive-script", participant))
        self._seen: deque[list[str]] = deque(maxlen=1 + int(self._draw.integers(self.DELAY)))
        self._slips = float(self._draw.uniform(0.0, self.SLIPS))
        self._wrong: list[str] = []

    def keys(self, header: Mapping[str, Any]) -> list[str]:
        """Return the keys that are held at a frame."""
        self._seen.append(to_the_goal(header))
        if not self._wrong and self._draw.random() < self._slips:
            self._wrong = [str(self._draw.choice(ARROWS))] * self.HELD
        return [self._wrong.pop()] if self._wrong else self._seen[0]

    def answers(self, form: Mapping[str, Any]) -> dict[str, Any]:
        """Agree, and draw every scale."""
        scales = {scale["name"]: float(self._draw.integers(0, 101)) for scale in form["scales"]}
        return {"agreed": True if form["name"] == "consent" else None, "scales": scales}


async def drive(address: str, driver: Driver = to_the_goal, answers: Callable[[Mapping[str, Any]], dict[str, Any]] | None = None) -> int:
    """Drive a whole session, from the first frame to the end; returns how many frames were seen.

    Args:
        address: what `wasp drive` prints.
        driver: who presses keys.
        answers: of a form; None: consent, and the middle of every scale.

    Raises:
        WaspError: the connection was lost, or there is none.
    """
    frames, held, number = 0, [""], 0
    async with await connected(address) as ws:

        async def send(message: Mapping[str, Any]) -> None:
            text = json.dumps(message)
            assert len(text) <= LONGEST
            await ws.send(text)

        async def alive() -> None:
            while True:
                await asyncio.sleep(1.0)
                await send({"type": "alive"})

        beating = asyncio.create_task(alive())
        try:
            async for message in ws:
                if isinstance(message, bytes):
                    header, _ = unpacked(message)
                    frames += 1
                    await send({"type": "ack", "frame": header["frame"]})
                    keys = driver(header)
                    if keys != held:
                        held, number = keys, number + 1
                        await send({"type": "input", "number": number, "keys": keys, "axes": [0.0, 0.0]})
                    continue
                state = json.loads(message)
                if state.get("type") != "state":
                    continue
                if state["phase"] in ("ready", "paused"):
                    held = [""]
                    await send({"type": "ask", "what": "go"})
                elif state["phase"] == "form":
                    given = middling(state["form"]) if answers is None else answers(state["form"])
                    await send({"type": "answers", **given})
                elif state["phase"] == "over":
                    return frames
        except ConnectionClosed as error:
            raise WaspError(
                f"the scripted driver lost its connection after {frames} frames", "the machine may be too busy: try again with --speed 0.5"
            ) from error
        finally:
            beating.cancel()
    return frames


async def connected(address: str) -> ClientConnection:
    """Connect as a page does: again, where the server is too busy to answer or others take its places."""
    parts, left = urlsplit(address), ATTEMPTS
    while True:
        try:
            return await connect(f"ws://{parts.netloc}/socket?{parts.query}", max_size=LARGEST, ping_interval=None, compression=None)
        except (OSError, InvalidHandshake) as error:  # TimeoutError is an OSError
            left -= 1
            if not left:
                raise WaspError(f"the scripted driver cannot connect: {error}", "the machine may be too busy: try again") from error
        await asyncio.sleep(PAUSE)


def middling(form: Mapping[str, Any]) -> dict[str, Any]:
    """Agree, and put every scale in the middle."""
    return {"agreed": True if form["name"] == "consent" else None, "scales": {scale["name"]: 50.0 for scale in form["scales"]}}
