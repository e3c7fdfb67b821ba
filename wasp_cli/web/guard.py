"""Limits in front of the token: who has not sent a whole request waits for a short time only, and few wait at once.

Half-sent requests and idle connections cost their sender nothing, and this process a descriptor each. Where there are too many, the one
that has waited longest goes: a browser sends its request whole, so that it is never among these.
"""

from __future__ import annotations

import asyncio
import resource
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

PATIENCE = 10.0
"""Seconds for a whole request, its body included."""
MOST = 64
"""Connections that wait at once, where the system allows eight times as many descriptors; otherwise an eighth of these."""
BACKLOG = 16
"""Connections that are accepted at once: they are there before anything of ours is asked."""


def guarded() -> type[H11Protocol]:
    """Return the protocol of the connections of one server."""
    waiting: dict[H11Protocol, asyncio.TimerHandle] = {}
    most = most_waiting()

    class Guarded(H11Protocol):
        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._wait()
            if len(waiting) > most:
                longest = next(iter(waiting))
                waiting.pop(longest).cancel()
                longest.transport.abort()

        def connection_lost(self, exc: Exception | None) -> None:
            self._settled()
            super().connection_lost(exc)

        def handle_events(self) -> None:
            super().handle_events()
            if self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
                self._settled()

        def handle_websocket_upgrade(self, event: h11.Request) -> None:
            self._settled()
            super().handle_websocket_upgrade(event)

        def on_response_complete(self) -> None:
            if not self.transport.is_closing():
                self._wait()
            super().on_response_complete()

        def _wait(self) -> None:
            """Begin to wait for a request, behind all others."""
            self._settled()
            waiting[self] = self.loop.call_later(PATIENCE, self.transport.abort)

        def _settled(self) -> None:
            if (timer := waiting.pop(self, None)) is not None:
                timer.cancel()

    return Guarded


def most_waiting() -> int:
    """Return how many connections may wait at once."""
    allowed, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MOST if allowed == resource.RLIM_INFINITY else max(1, min(MOST, allowed // 8))
