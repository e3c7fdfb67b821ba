"""How far runs are, as `wasp status` prints it, and as a board shows it below its lines."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from datetime import UTC, datetime
from typing import Any

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from wasp_cli.console import duration
from wasp_cli.run.watch import STALE_SECONDS, RunState

BAR = 40
LISTED = 12


def show_status(states: list[RunState], console: Console) -> None:
    """Print how far runs are."""
    now = datetime.now(UTC)
    for index, state in enumerate(states):
        if index:
            console.print()
        console.print(_block(state, now), soft_wrap=True)


def progress_of(state: RunState, names: Mapping[str, str]) -> Group:
    """Return what a board shows: bar, time left and running nodes. `names` are what users call a
    node, by its key, if that is not its label.
    """
    named = tuple(replace(node, label=names.get(node.key, node.label)) for node in state.active)
    table = _running_table(replace(state, active=named), datetime.now(UTC))
    return Group(
        _progress(state), *(Text(line) for line in (pace(state), state.deserted) if line), table
    )


def as_json(states: list[RunState]) -> list[dict[str, Any]]:
    """Return how far runs are as `wasp status --json` prints it."""
    counts = ("finished", "running", "waiting")
    rows = [
        {**asdict(state), **{name: getattr(state, name) for name in counts}} for state in states
    ]
    plain_rows: list[dict[str, Any]] = json.loads(
        json.dumps(rows, default=lambda moment: moment.isoformat(timespec="seconds"))
    )
    return plain_rows


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
    """Return in a line whether a run goes on, and when it began and ended."""
    if state.state == "not started":
        return "planned, or driven by a person: no run has computed anything"
    if state.idle:
        return "nothing had to be computed"
    since = f"started {_when(state.started)}" if state.started else ""
    if state.state == "running":
        parts = ["running", since, _span(state.started, now)]
        if state.draining:
            parts.append("finishing running nodes")
        elif state.deserted:
            parts.append("no worker is left")
        return ", ".join(filter(None, parts))
    how = "died; its last event was" if state.state == "died" else state.state
    took = _span(state.started, state.ended)
    end = f"{how} {_when(state.ended)}"
    return f"{end}, after {took} ({since})" if took else end


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
    """Return how long a run still takes, in words; empty if it is over or that is not known."""
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
        odd = ""
        if node.gone or state.state == "died":
            odd = "gone"
        elif silent > STALE_SECONDS:
            odd = f"silent for {duration(silent)}"
        texts = (f"  {node.label}", f"{node.share:4.0%}", _span(node.started, now), memory, odd)
        rows.add_row(*map(Text, texts), Text(node.text, style="dim"))
    return rows
