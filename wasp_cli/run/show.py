"""What the commands print of runs: their state, the log of a node, what gc can remove, and what is published."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from wasp_cli.console import count_table, duration, size
from wasp_cli.errors import StoreError, UnknownName, UsageError, WaspError, first
from wasp_cli.plan.recorded import PlannedRun
from wasp_cli.store.find import SHOWN, find_node, matching, same_label
from wasp_cli.store.gc import FAILURES, LOCKS, RUNS, TMP, WORK, Rubbish
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import open_plain, printable
from wasp_cli.store.published import FROM_PUBLISHED

if TYPE_CHECKING:
    from wasp_cli.run.publish import Publication
    from wasp_cli.run.watch import RunState

BAR = 40
STALE_SECONDS = 30.0  # a node says about every second that it lives; silence for longer is worth a word
LISTED = 12


def show_status(states: list[RunState], console: Console, now: datetime | None = None) -> None:
    """Print each run as a block."""
    now = now or datetime.now(UTC)
    for index, state in enumerate(states):
        if index:
            console.print()
        console.print(_block(state, now), soft_wrap=True)


def progress_of(state: RunState, names: Mapping[str, str], now: datetime | None = None) -> Group:
    """Return what changes while a run goes on: bar, pace and running nodes; `names` are by key, where a label does not say enough."""
    named = tuple(replace(node, label=names.get(node.key, node.label)) for node in state.active)
    table = _running_table(replace(state, active=named), now or datetime.now(UTC))
    return Group(_progress(state), *(Text(line) for line in (pace(state), state.deserted) if line), table)


def as_json(states: list[RunState]) -> list[dict[str, Any]]:
    """Return this as plain values; times are ISO texts."""
    counts = ("finished", "running", "waiting")
    return [_plain({**asdict(state), **{name: getattr(state, name) for name in counts}}) for state in states]


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.isoformat(timespec="seconds")
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    return [_plain(part) for part in value] if isinstance(value, list | tuple) else value


def _block(state: RunState, now: datetime) -> Group:
    title = Text.assemble((state.spec, "bold"), f"  {life(state, now)}")
    parts: list[Text | Table] = [title, Text(f"run {state.run_id}", style="dim"), _progress(state)]
    parts += [Text(words, style=style) for words, style in ((pace(state), ""), (state.deserted, "yellow")) if words]
    if state.active and state.state in ("running", "died"):
        parts.append(_running_table(state, now))
    for failure in state.failed[:LISTED]:
        parts.append(Text.assemble(("FAILED ", "red"), f"{failure.label}: {failure.message}"))
        if failure.log:
            parts.append(Text(f"       log: {failure.log}", style="dim"))
    if len(state.failed) > LISTED:
        parts.append(Text(f"       and {len(state.failed) - LISTED} more; --json lists all"))
    return Group(*parts)


def life(state: RunState, now: datetime) -> str:
    """Say whether a run goes on, since when, and how it ended."""
    if state.state == "not started":
        return "planned; nothing computed yet"
    if state.idle:
        return "nothing had to be computed"
    since = f"started {_when(state.started)}" if state.started else ""
    if state.state == "running":
        endings = {"finishing running nodes": state.draining, "paused": state.paused, "no worker is left": state.deserted}
        ending = next((words for words, holds in endings.items() if holds), "")
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
    others = {"failed": len(state.failed), "blocked": state.blocked, "cancelled": state.cancelled, "retried": state.retried}
    counts += [f"{count} {how}" for how, count in others.items() if count]
    if state.waiting:
        counts.append(f"{state.waiting} {'waiting' if state.state == 'running' else 'not computed'}")
    return Text.assemble("[", ("=" * filled, "green"), " " * (BAR - filled), f"] {', '.join(counts)}")


def pace(state: RunState) -> str:
    """Say how long a run takes yet; of one that is over, nothing."""
    if state.state != "running" or state.left_seconds is None:
        return ""
    known = f", not counting {state.unknown} nodes whose time is unknown" if state.unknown else ""
    return f"about {duration(state.left_seconds)} left{known}"


def _running_table(state: RunState, now: datetime) -> Table:
    rows = Table.grid(padding=(0, 2))
    for node in state.active:
        memory = f"{node.memory_mb:.0f} MB" if node.memory_mb is not None else ""
        silent = (now - node.seen).total_seconds() if node.seen else 0.0
        odd = f"silent for {duration(silent)}" if silent > STALE_SECONDS else ""
        if node.gone or state.state == "died":
            odd = "gone"
        texts = (f"  {node.label}", f"{node.share:4.0%}", _span(node.started, now), memory, odd)
        rows.add_row(*map(Text, texts), Text(node.text, style="dim"))
    return rows


LAST = (WORK, FAILURES, RUNS, TMP, LOCKS)


def show_rubbish(rubbish: Sequence[Rubbish], console: Console) -> None:
    """Print how much of each kind can go."""
    if not rubbish:
        console.print("there is nothing to remove")
        return
    table = count_table("what can go", "count", "size")
    kinds = sorted({item.what for item in rubbish} - set(LAST)) + [what for what in LAST if any(item.what == what for item in rubbish)]
    for kind in kinds:
        sizes = [item.size for item in rubbish if item.what == kind]
        table.add_row(Text(kind), str(len(sizes)), size(sum(sizes)))
    table.add_section()
    table.add_row("total", str(len(rubbish)), size(sum(item.size for item in rubbish)), style="bold")
    console.print(table)


def removed_line(count: int, freed: int) -> str:
    """Return what a removal came to."""
    return f"{count} removed, {size(freed)} freed"


def show_publication(publication: Publication, largest: float, console: Console) -> None:
    """Print how much of each kind is published, how much was published before, and what is left out."""
    table = count_table("kind", "new", "size", "there already")
    for kind in dict.fromkeys(item.node.kind for item in (*publication.new, *publication.there)):
        sizes = [item.size for item in publication.new if item.node.kind == kind]
        there = sum(item.node.kind == kind for item in publication.there)
        table.add_row(Text(kind), str(len(sizes)), size(sum(sizes)), str(there or "-"))
    reports = [path.stat().st_size for path in publication.reports]
    table.add_row("report", str(len(reports)), size(sum(reports)), "-")
    table.add_section()
    total = sum(item.size for item in publication.new) + sum(reports)
    table.add_row("total", str(len(publication.new) + len(reports)), size(total), str(len(publication.there)), style="bold")
    console.print(table)
    for item in publication.large:
        text = f"left out: {item.node.label} has {size(item.size)}, more than {size(round(largest))} (--largest)"
        console.print(text, markup=False, soft_wrap=True)
    if publication.absent:
        kinds = ", ".join(dict.fromkeys(node.kind for node in publication.absent))
        console.print(f"left out: {len(publication.absent)} nodes that were not computed, since nothing needs them: {kinds}", markup=False)


_COLOUR = re.compile("(\x1b\\[[0-9;]*m)")


@dataclass(frozen=True)
class Log:
    """What a node printed in one run."""

    run_id: str
    key: str
    label: str
    path: Path


def find_log(layout: Layout, runs: list[PlannedRun], text: str) -> Log:
    """Return the newest log of the node that `text` names, by the beginning of its key or its label, in `runs`, newest first."""
    name = " ".join(text.split())
    logs = [log for run in runs for log in _logs(layout, run)]
    matches = matching(logs, name)
    if matches and same_label(matches[0].label, name):
        # A label may have had another key in an older run; there it is another node's.
        matches = [log for log in matches if log.run_id == matches[0].run_id]
    newest = {log.key: log for log in reversed(matches)}
    if len(newest) > 1:
        lines = [f"'{name}' names {len(newest)} nodes:", *first([f"  {log.key}  {log.label}" for log in newest.values()], SHOWN)]
        raise UsageError("\n".join(lines), "give the first characters of one of these keys")
    if newest:
        return next(iter(newest.values()))
    try:
        node = find_node(layout, name)
    except WaspError:
        message, hint = f"no log of '{name}' in '{layout.root}'", "give a key or a label, as wasp status shows them"
        raise UnknownName("node", name, {log.label for log in logs}, message, otherwise=hint) from None
    published = node.setting("provenance", FROM_PUBLISHED) is True
    how = "it is a published result, computed elsewhere" if published else "it was not computed in a run of this folder"
    raise UsageError(f"'{printable(node.label or name)}' has no log: {how}", f"wasp show {(node.key or '')[:8]} shows what is known of it")


def write_log(log: Log, stream: TextIO) -> None:
    """Copy a log to a stream: to a file or a pipe as it is, to a terminal without what would command it."""
    try:
        file = open_plain(log.path)
    except OSError as error:
        raise StoreError(f"cannot read '{log.path}': {(error.strerror or str(error)).lower()}") from error
    terminal = stream.isatty()
    with io.TextIOWrapper(file, encoding="utf-8", errors="replace", newline="\n") as lines:
        for line in lines:
            if terminal:  # of a bar that redraws itself, the last state; colours, and nothing else that a terminal obeys
                last = line.rstrip("\r\n").rpartition("\r")[2]
                parts = [part if index % 2 else printable(part) for index, part in enumerate(_COLOUR.split(last))]
                line = "".join(parts) + ("\n" if line.endswith("\n") else "")
            stream.write(line)


def _logs(layout: Layout, run: PlannedRun) -> list[Log]:
    """The logs that a run has: of what it computed, or tried to."""
    try:
        with os.scandir(layout.within(layout.run(run.run_id) / "logs")) as entries:
            there = {entry.name for entry in entries if entry.is_file(follow_symlinks=False)}
    except (OSError, StoreError):
        return []
    paths = [(node, layout.log(run.run_id, node.label, node.key)) for node in run.nodes.values()]
    return [Log(run.run_id, node.key, node.label, path) for node, path in paths if path.name in there]
