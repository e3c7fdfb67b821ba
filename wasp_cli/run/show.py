"""What a run shows while it goes on, a live board on a terminal and plain lines elsewhere, and what
commands print of runs and of logs.

The board goes to stderr; all of it is read from the journal, the plan, and the small files of
running nodes.
"""

from __future__ import annotations

import io
import json
import os
import re
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live as RichLive
from rich.table import Table
from rich.text import Text

from wasp_cli.cells.runs import RunRecord, planned_run
from wasp_cli.console import duration, err, plain
from wasp_cli.errors import StoreError, UnknownName, UsageError, WaspError
from wasp_cli.run.record import Tail
from wasp_cli.run.watch import STALE_SECONDS, RunState, desertion, running_records, state_of
from wasp_cli.store.find import find_node
from wasp_cli.store.layout import Layout
from wasp_cli.store.named import matching, only, same_label
from wasp_cli.store.plain import open_plain, printable
from wasp_cli.store.published import FROM_PUBLISHED

OPERATING_POINT = "operating_point"  # what the stage `operating` says in words
POLL_SECONDS = 0.25
NOTES = {
    "workers back": "workers are back; the run goes on",
    "draining": "finishing running nodes; Ctrl-C again stops now",
    "waiting": "another run computes what is needed now; waiting",
}
SHARE = 0.05  # of one core, that drawing the board may take: a long journal is read less often


class Lines:
    """One line for each event of a run, as the journal gets it. Starts come from the running
    files, so short nodes show their end only.
    """

    starts = True  # whether a node's start is worth a line

    def __init__(self, layout: Layout, run_id: str, total: int, names: Mapping[str, str]) -> None:
        self._layout, self._run_id, self._total, self._names = layout, run_id, total, names
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
        key, kind = str(event.get("key")), event["event"]
        name = self._names.get(key, str(event.get("label")))
        if kind in ("done", "shared", "failed"):
            self._shown.add(key)
            detail = event.get("message" if kind == "failed" else "numbers")
            what = "FAILED" if kind == "failed" else kind
            plain(
                f"{self._counter()} {what:<7} {name}  {duration(event['seconds'])}"
                + (f"  {detail}" if detail else "")
            )
        elif kind == "blocked":
            plain(
                f"{self._counter()} blocked {name}  (needs "
                f"{self._names.get(event['by'], event['by_label'])})"
            )
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
            after = (
                f"; these nodes run again{'' if reason else ', one at a time'}: {', '.join(labels)}"
                if labels
                else " while it was idle"
            )
            self._note(
                (f"a worker ended ({reason})" if reason else "a worker process was killed") + after
            )
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
    """A board that redraws itself under the lines: a bar, the pace, what remains, and the
    running nodes with their share.
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
    """Return the board that fits where stderr goes; `names` are what people call a node, by its
    key, where that is not its label.
    """
    fitting = Live if err().is_terminal and not err().is_dumb_terminal else Lines
    return fitting(layout, run_id, total, names)


def numbers(summary: Mapping[str, Any]) -> str:
    values = [(name, value) for name, value in summary.items() if isinstance(value, int | float)]
    told = [
        f"{name} {value}" if isinstance(value, int) else f"{name} {value:.4g}"
        for name, value in values[:6]
    ]
    point = summary.get(OPERATING_POINT)
    if isinstance(point, str):
        told.insert(0, printable(point))
    return ", ".join(told)


BAR = 40
LISTED = 12


def show_status(states: list[RunState], console: Console) -> None:
    now = datetime.now(UTC)
    for index, state in enumerate(states):
        if index:
            console.print()
        console.print(_block(state, now), soft_wrap=True)


def progress_of(state: RunState, names: Mapping[str, str]) -> Group:
    """Return what changes while a run goes on: bar, pace and running nodes; `names` are by key,
    where a label does not say enough.
    """
    named = tuple(replace(node, label=names.get(node.key, node.label)) for node in state.active)
    table = _running_table(replace(state, active=named), datetime.now(UTC))
    return Group(
        _progress(state), *(Text(line) for line in (pace(state), state.deserted) if line), table
    )


def as_json(states: list[RunState]) -> list[dict[str, Any]]:
    counts = ("finished", "running", "waiting")
    rows = [
        {**asdict(state), **{name: getattr(state, name) for name in counts}} for state in states
    ]
    told: list[dict[str, Any]] = json.loads(
        json.dumps(rows, default=lambda moment: moment.isoformat(timespec="seconds"))
    )
    return told


def _block(state: RunState, now: datetime) -> Group:
    title = Text.assemble((state.spec, "bold"), f"  {life(state, now)}")
    parts: list[Text | Table] = [title, Text(f"run {state.run_id}", style="dim"), _progress(state)]
    parts += [
        Text(words, style=style)
        for words, style in ((pace(state), ""), (state.deserted, "yellow"))
        if words
    ]
    if state.active and state.state in ("running", "died"):
        parts.append(_running_table(state, now))
    for line in state.short[:LISTED]:
        parts.append(Text.assemble(("SHORT  ", "yellow"), line))
    if len(state.short) > LISTED:
        parts.append(Text(f"       and {len(state.short) - LISTED} more; --json lists all"))
    for failure in state.failed[:LISTED]:
        parts.append(Text.assemble(("FAILED ", "red"), f"{failure.label}: {failure.message}"))
        if failure.log:
            parts.append(Text(f"       log: {failure.log}", style="dim"))
    if len(state.failed) > LISTED:
        parts.append(Text(f"       and {len(state.failed) - LISTED} more; --json lists all"))
    return Group(*parts)


def life(state: RunState, now: datetime) -> str:
    if state.state == "not started":
        return "planned, or driven by a person: no run has computed anything"
    if state.idle:
        return "nothing had to be computed"
    since = f"started {_when(state.started)}" if state.started else ""
    if state.state == "running":
        ending = (
            "finishing running nodes"
            if state.draining
            else "no worker is left"
            if state.deserted
            else ""
        )
        return ", ".join(filter(None, ("running", since, _span(state.started, now), ending)))
    how = "died; its last event was" if state.state == "died" else state.state
    took = _span(state.started, state.ended)
    return f"{how} {_when(state.ended)}" + (f", after {took} ({since})" if took else "")


def _span(start: datetime | None, end: datetime | None) -> str:
    return duration(max((end - start).total_seconds(), 0.0)) if start and end else ""


def _when(moment: datetime | None) -> str:
    return f"{moment:%Y-%m-%d %H:%M} UTC" if moment else "at an unknown time"


def _progress(state: RunState) -> Text:
    done = state.done + state.shared
    filled = round(BAR * min(done / state.total, 1.0)) if state.total else BAR
    counts = [f"{done} of {state.total} done"]
    if state.state == "running":
        counts.append(f"{state.running} running")
    others = {"failed": len(state.failed), "blocked": state.blocked, "retried": state.retried}
    counts += [f"{count} {how}" for how, count in others.items() if count]
    if state.waiting:
        counts.append(
            f"{state.waiting} {'waiting' if state.state == 'running' else 'not computed'}"
        )
    return Text.assemble(
        "[", ("=" * filled, "green"), " " * (BAR - filled), f"] {', '.join(counts)}"
    )


def pace(state: RunState) -> str:
    """Say how long a run takes yet; of one that is over, nothing."""
    if state.state != "running" or state.left_seconds is None:
        return ""
    missing = []
    if state.unknown:
        missing.append(f"{state.unknown} nodes whose time is unknown")
    if state.unmeasured:
        missing.append(f"{state.unmeasured:,} decisions in an environment not measured yet")
    known = f", not counting {' and '.join(missing)}" if missing else ""
    return f"about {duration(state.left_seconds)} left{known}"


def _running_table(state: RunState, now: datetime) -> Table:
    rows = Table.grid(padding=(0, 2))
    for node in state.active:
        memory = f"{node.memory_mb:.0f} MB" if node.memory_mb is not None else ""
        silent = (now - node.seen).total_seconds() if node.seen else 0.0
        gone = node.gone or state.state == "died"
        odd = "gone" if gone else f"silent for {duration(silent)}" if silent > STALE_SECONDS else ""
        texts = (f"  {node.label}", f"{node.share:4.0%}", _span(node.started, now), memory, odd)
        rows.add_row(*map(Text, texts), Text(node.text, style="dim"))
    return rows


_COLOUR = re.compile("(\x1b\\[[0-9;]*m)")


@dataclass(frozen=True)
class Log:
    run_id: str
    key: str
    label: str
    path: Path


def find_log(layout: Layout, runs: list[RunRecord], text: str) -> Log:
    name = " ".join(text.split())
    logs = [log for run in runs for log in _logs(layout, run)]
    matches = matching(logs, name)
    if matches and same_label(matches[0].label, name):
        # A label may have had another key in an older run; there it is another node's.
        keys = {log.key for log in matches if log.run_id == matches[0].run_id}
        matches = [log for log in matches if log.key in keys]
    # the log of a run that found a node computed by another is empty
    matches.sort(key=lambda log: log.path.stat().st_size == 0)
    newest = {log.key: log for log in reversed(matches)}
    if (log := only(list(newest.values()), name, "nodes")) is not None:
        return log
    try:
        node = find_node(layout, name)
    except WaspError:
        message, hint = (
            f"no log of '{name}' in '{layout.root}'",
            "give a key or a label, as wasp status shows them",
        )
        raise UnknownName(
            "node", name, {log.label for log in logs}, message, otherwise=hint
        ) from None
    published = node.setting("provenance", FROM_PUBLISHED) is True
    how = (
        "it is a published result, computed elsewhere"
        if published
        else "it was not computed in a run of this folder"
    )
    raise UsageError(
        f"'{printable(node.label or name)}' has no log: {how}",
        f"wasp show {(node.key or '')[:8]} shows what is known of it",
    )


def write_log(log: Log, stream: TextIO) -> None:
    """Copy a log to a stream: to a file or a pipe as it is, to a terminal without what would
    command it.
    """
    try:
        file = open_plain(log.path)
    except OSError as error:
        raise StoreError(
            f"cannot read '{log.path}': {(error.strerror or str(error)).lower()}"
        ) from error
    terminal = stream.isatty()
    with io.TextIOWrapper(file, encoding="utf-8", errors="replace", newline="\n") as lines:
        for line in lines:
            # of a bar that redraws itself, the last state; colours, and nothing else that a
            # terminal obeys
            if terminal:
                last = line.rstrip("\r\n").rpartition("\r")[2]
                parts = [
                    part if index % 2 else printable(part)
                    for index, part in enumerate(_COLOUR.split(last))
                ]
                line = "".join(parts) + ("\n" if line.endswith("\n") else "")
            stream.write(line)


def _logs(layout: Layout, run: RunRecord) -> list[Log]:
    try:
        with os.scandir(layout.within(layout.run(run.run_id) / "logs")) as entries:
            there = {entry.name for entry in entries if entry.is_file(follow_symlinks=False)}
    except (OSError, StoreError):
        return []
    paths = [(node, layout.log(run.run_id, node.label, node.key)) for node in run.nodes.values()]
    return [
        Log(run.run_id, node.key, node.label, path) for node, path in paths if path.name in there
    ]
