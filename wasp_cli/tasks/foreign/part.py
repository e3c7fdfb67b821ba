"""A process that holds some rows of a batch of foreign environments, from outside; what it does
there is in `serving`.

It is started afresh and not forked, so that it shares nothing with the process that asks but a
socket and the arrays that both see. It is no process of `multiprocessing`: those of a dask worker
may have no children, and a run may have no semaphores. It leads a session of its own, so that a
Ctrl-C in the terminal does not reach it. It closes its environments and ends when the other end of
the socket is closed, also because the process there is gone; and what its environments have
started ends with it (see `started`).
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import asdict
from typing import IO, Any

from wasp_cli.errors import EnvironmentDied, TaskError, UnknownName
from wasp_cli.tasks.foreign.closing import CLOSE_SECONDS
from wasp_cli.tasks.foreign.messages import Arrays, receive, send
from wasp_cli.tasks.foreign.serving import Begin, serve
from wasp_cli.tasks.foreign.started import mark

Request = tuple[str, list[object]]
"""The name of a method of `serving.Served`, and its arguments."""
LOOK_SECONDS = 1.0
"""Between two looks for an answer, where a time limit of another thread may be heard."""
GONE_SECONDS = 5.0
"""Until a process is gone that has closed its socket, or has told what went wrong in closing."""
# The modules of the environment lie where this process has found them, and nowhere else.
_PROGRAM = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    f"from {serve.__module__} import serve; serve(int(sys.argv[2]))"
)
_CAUSES = {
    signal.SIGKILL: "the system kills what takes too much memory: fewer environments side by side "
    "take less",
    signal.SIGSEGV: "native code of the environment failed; what ran then stands above, or in the "
    "log of the node",
    signal.SIGABRT: "native code of the environment gave up; what it said stands above, or in the "
    "log of the node",
}


class Part:
    """The process of some rows, from outside."""

    def __init__(self, begin: Begin) -> None:
        """Start it; its first answer says what its environment is."""
        self.begin = begin
        mark()
        ours, theirs = socket.socketpair()
        arguments = [json.dumps(sys.path), str(theirs.fileno())]
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _PROGRAM, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            pass_fds=(theirs.fileno(), begin.memory),
            start_new_session=True,
        )
        theirs.close()
        self._socket = ours
        self._stream = ours.makefile("rwb")
        self._tell(asdict(begin))

    @property
    def pid(self) -> int:
        """The number of its process."""
        return self._process.pid

    def send(self, request: Request, arrays: Arrays | None = None) -> None:
        """Ask for something. Raises EnvironmentDied."""
        self._tell(request, arrays)

    def _tell(self, value: object, arrays: Arrays | None = None) -> None:
        try:
            send(self._stream, value, arrays)
        except OSError as error:
            raise self._died() from error

    def answer(self) -> Any:
        """Wait for the answer to what was asked, and return its arrays, or else its value.

        Raises:
            EnvironmentDied: the process has ended.
            WaspError: what the request failed with.
        """
        # A wait without an end would not let another thread's time limit come through.
        while not select.select([self._socket], [], [], LOOK_SECONDS)[0]:
            pass
        try:
            answer, arrays = receive(self._stream)
        except (OSError, EOFError) as error:
            raise self._died() from error
        if "error" not in answer:
            return arrays or answer["value"]
        message = answer["error"]
        hint = answer["hint"]
        if answer["kind"] == UnknownName.__name__:
            raise UnknownName("gymnasium id", self.begin.name, (), message, hint)
        raise TaskError(message, hint)

    def _died(self) -> EnvironmentDied:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(GONE_SECONDS)
        code = self._process.returncode
        hint = None
        if code is None:
            how = "does not answer any more"
        elif code < 0:
            how = f"was ended by {signal.Signals(-code).name}"
            hint = _CAUSES.get(signal.Signals(-code))
        else:
            how = f"ended by itself, with exit code {code}"
            hint = "an environment must not end its process; what it said stands above"
        last = self.begin.first + self.begin.rows - 1
        rows = f"row {last}" if self.begin.rows == 1 else f"rows {self.begin.first} to {last}"
        return EnvironmentDied(
            f"environment '{self.begin.name}': the process of {rows} {how}", hint
        )

    def leave(self) -> None:
        """Let it close its environments and end; it does so as soon as it has answered."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> list[str]:
        """Wait until it is gone, after `leave`, and return what went wrong in closing.

        One that does not come back is killed.
        """
        assert self._process.stdout is not None
        troubles = [f"environment '{self.begin.name}' did not close within {CLOSE_SECONDS:g} s"]
        # An environment may take its time, and before that what was asked last.
        end = time.monotonic() + CLOSE_SECONDS * (self.begin.rows + 2)
        said = _read_until(self._process.stdout, end)
        if said is not None:
            troubles = json.loads(said)
        elif self._process.poll() is not None:
            troubles = []  # it has died, which was told when it was needed
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(GONE_SECONDS)
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()
        with suppress(OSError):
            self._stream.close()
        self._socket.close()
        return troubles


def _read_until(stream: IO[bytes], end: float) -> bytes | None:
    """Read a line; None where there is none until `end` (of the monotonic clock)."""
    said = b""
    while not said.endswith(b"\n"):
        left = end - time.monotonic()
        if left <= 0 or not select.select([stream], [], [], left)[0]:
            return None
        piece = os.read(stream.fileno(), 65536)
        if not piece:
            return None
        said += piece
    return said
