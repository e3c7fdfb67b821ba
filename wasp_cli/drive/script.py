"""A scripted driver: presses the keys that lead to the goal, as a page would. For checks of the timing and for trials of a study.

It talks to the real socket, so that everything but the browser is what a person meets.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio.client import connect

from wasp_cli.drive.server import LONGEST, unpacked
from wasp_cli.tasks.frames import wrapped

AHEAD, ASIDE = 1.0, 0.25
"""Angles to the goal in rad: below the first it drives forward, above the second it turns."""
LARGEST = 4_000_000
"""Bytes of what the server sends at most: the picture of the ground is the largest."""

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


async def drive(address: str, driver: Driver = to_the_goal, answers: Callable[[Mapping[str, Any]], dict[str, Any]] | None = None) -> int:
    """Drive a whole session, from the first frame to the end; returns how many frames were seen.

    Args:
        address: what `wasp drive` prints.
        driver: who presses keys.
        answers: of a form; None: consent, and the middle of every scale.
    """
    parts = urlsplit(address)
    frames, held, number = 0, [""], 0
    async with connect(f"ws://{parts.netloc}/socket?{parts.query}", max_size=LARGEST, ping_interval=None, compression=None) as ws:

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
        finally:
            beating.cancel()
    return frames


def middling(form: Mapping[str, Any]) -> dict[str, Any]:
    """Agree, and put every scale in the middle."""
    return {"agreed": True if form["name"] == "consent" else None, "scales": {scale["name"]: 50.0 for scale in form["scales"]}}
