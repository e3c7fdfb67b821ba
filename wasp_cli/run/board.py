"""The progress of a run on stderr: a live board on a terminal, plain lines elsewhere.

It is read from the journal, the plan, and the small files of running nodes.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any

from rich.console import RenderableType
from rich.live import Live as RichLive

from wasp_cli.cells.runs import planned_run
from wasp_cli.console import duration, err, plain
from wasp_cli.run.record import Tail
from wasp_cli.run.status import progress_of
from wasp_cli.run.watch import desertion, running_records, state_of
from wasp_cli.store.layout import Layout

POLL_SECONDS = 0.25
NOTES = {
    "workers back": "workers are back; the run goes on",
    "draining": "finishing running nodes; Ctrl-C again stops now",
    "waiting": "another run computes what is needed now; waiting",
}
SHARE = 0.05  # of one core, that drawing the board may take: a long journal is read less often


class Lines:
    """Prints a line for each event of a run as it is written to the journal. Starts are read from
    the files of running nodes, so that short nodes may show only their end.
    """

    starts = True  # whether a node's start is worth a line

    def __init__(self, layout: Layout, run_id: str, total: int, names: Mapping[str, str]) -> None:
        self._layout = layout
        self._run_id = run_id
        self._total = total
        self._names = names
        self._tail = Tail(layout.journal(run_id))
        self._count = 0
        self._shown: set[str] = set()
        self._stop = threading.Event()
        self._watcher = threading.Thread(target=self._watch, daemon=True, name="progress")

    def __enter__(self) -> Lines:
        self._watcher.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._watcher.join()
        self._events()

    def _watch(self) -> None:
        while not self._stop.wait(POLL_SECONDS):
            self._events()
            if self.starts:
                self._started()

    def _events(self) -> None:
        for event in self._tail.new():
            self._event(event)

    def _event(self, event: Mapping[str, Any]) -> None:
        key = str(event.get("key"))
        kind = event["event"]
        name = self._names.get(key, str(event.get("label")))
        if kind in ("done", "shared", "failed"):
            self._shown.add(key)
            state = kind
            detail = event.get("numbers")
            if kind == "failed":
                state = "FAILED"
                detail = event.get("message")
            line = f"{self._counter()} {state:<7} {name}  {duration(event['seconds'])}"
            if detail:
                line += f"  {detail}"
            plain(line)
        elif kind == "blocked":
            cause = self._names.get(event["by"], event["by_label"])
            plain(f"{self._counter()} blocked {name}  (needs {cause})")
        elif kind == "retry":
            self._note(f"{name} runs again, attempt {event['attempt']}: {event['message']}")
        elif kind == "unclosed":
            self._note(f"{event['message']} (after {name}; results are kept); {event['hint']}")
        elif kind == "short":
            self._note(f"{name} falls short: {event['message']}; {event['hint']}")
        elif kind == "worker killed":
            labels = [
                self._names.get(suspect, label)
                for suspect, label in zip(event["suspects"], event["labels"], strict=True)
            ]
            reason = event.get("reason")
            if reason:
                what = f"a worker ended ({reason})"
                again = "run again"
            else:
                what = "a worker process was killed"
                again = "run again, one at a time"
            if labels:
                self._note(f"{what}; these nodes {again}: {', '.join(labels)}")
            else:
                self._note(f"{what} while it was idle")
        elif kind == "workers gone":
            self._note(
                f"{desertion(event)}; Ctrl-C twice ends the run, and finished nodes are kept"
            )
        elif kind in NOTES:
            self._note(NOTES[kind])

    def _started(self) -> None:
        for key, record in running_records(self._layout, self._run_id):
            if key not in self._shown:
                self._shown.add(key)
                text = f"  ({record['text']})" if record.get("text") else ""
                plain(f"        start   {self._names.get(key, str(record.get('label')))}{text}")

    def _note(self, text: str) -> None:
        plain(f"        note    {text}")

    def _counter(self) -> str:
        self._count += 1
        return f"[{self._count:>{len(str(self._total))}}/{self._total}]"


class Live(Lines):
    """Draws a board below the lines: a bar, the time that is left, and the running nodes with their
    share.
    """

    starts = False

    def __init__(self, layout: Layout, run_id: str, total: int, names: Mapping[str, str]) -> None:
        super().__init__(layout, run_id, total, names)
        self._run = planned_run(layout, run_id)
        self._drawn: RenderableType = ""
        self._next = 0.0
        self._live = RichLive(
            console=err(),
            get_renderable=self._draw,
            refresh_per_second=2,
            transient=True,
            redirect_stdout=False,
        )

    def __enter__(self) -> Live:
        super().__enter__()
        self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()
        super().__exit__(*error)

    def _draw(self) -> RenderableType:
        now = time.monotonic()
        if now >= self._next and self._run is not None:
            self._drawn = progress_of(state_of(self._layout, self._run), self._names)
            end = time.monotonic()
            self._next = end + max(0.4, (end - now) / SHARE)
        return self._drawn


def board(layout: Layout, run_id: str, total: int, names: Mapping[str, str]) -> Lines:
    """Return a live board if stderr is a terminal, else lines.

    Args:
        total: nodes that the run computes.
        names: what users call a node, by its key, if that is not its label.
    """
    if err().is_terminal and not err().is_dumb_terminal:
        return Live(layout, run_id, total, names)
    return Lines(layout, run_id, total, names)
