"""The log of one node, of whatever kind and however it ended."""

from __future__ import annotations

import io
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from wasp_cli.errors import StoreError, UnknownName, UsageError
from wasp_cli.plan.recorded import PlannedRun
from wasp_cli.store.find import SHOWN, begins, same_label
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import open_plain, printable

_COLOUR = re.compile("(\x1b\\[[0-9;]*m)")


@dataclass(frozen=True)
class Log:
    """What a node printed in one run."""

    run_id: str
    key: str
    label: str
    path: Path


def find_log(layout: Layout, runs: list[PlannedRun], text: str) -> Log:
    """Return the newest log of the node that `text` names: the beginning of its key, or its label.

    Args:
        layout: the results folder.
        runs: where to look, newest first.
        text: what someone wrote.

    Raises:
        UsageError: it names several nodes; the message lists them.
        UnknownName: it names none that has a log.
    """
    wanted = " ".join(text.split())
    logs = [log for run in runs for log in _logs(layout, run)]
    found = [log for log in logs if begins(log.key, wanted)]
    if not found:
        named = [log for log in logs if same_label(log.label, wanted)]
        # A label may have had another key in an older run; there it is another node's.
        found = [log for log in named if log.run_id == named[0].run_id]
    newest = {log.key: log for log in reversed(found)}
    if len(newest) > 1:
        raise UsageError(_several(wanted, list(newest.values())), "give the first characters of one of these keys")
    if not newest:
        message, hint = f"no log of '{wanted}' in '{layout.root}'", "give a key or a label, as wasp status shows them"
        raise UnknownName("node", wanted, {log.label for log in logs}, message, otherwise=hint)
    return next(iter(newest.values()))


def write_log(log: Log, stream: TextIO) -> None:
    """Copy a log to a stream: to a file or a pipe as it is, to a terminal without what would command it.

    Raises:
        StoreError: it cannot be read.
    """
    try:
        file = open_plain(log.path)
    except OSError as error:
        raise StoreError(f"cannot read '{log.path}': {(error.strerror or str(error)).lower()}") from error
    terminal = stream.isatty()
    with io.TextIOWrapper(file, encoding="utf-8", errors="replace", newline="\n") as lines:
        for line in lines:
            stream.write(_tamed(line) if terminal else line)


def _tamed(line: str) -> str:
    """A line with its colours and nothing else that a terminal obeys; of a bar that redraws itself, the last state."""
    last = line.rstrip("\r\n").rpartition("\r")[2]
    parts = [part if index % 2 else printable(part) for index, part in enumerate(_COLOUR.split(last))]
    return "".join(parts) + ("\n" if line.endswith("\n") else "")


def _logs(layout: Layout, run: PlannedRun) -> list[Log]:
    """The logs that a run has: of what it computed, or tried to."""
    try:
        with os.scandir(layout.within(layout.run(run.run_id) / "logs")) as entries:
            there = {entry.name for entry in entries if entry.is_file(follow_symlinks=False)}
    except (OSError, StoreError):
        return []
    paths = [(node, layout.log(run.run_id, node.label, node.key)) for node in run.nodes.values()]
    return [Log(run.run_id, node.key, node.label, path) for node, path in paths if path.name in there]


def _several(wanted: str, found: list[Log]) -> str:
    lines = [f"  {log.key}  {log.label}" for log in found[:SHOWN]]
    more = [f"  and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return "\n".join([f"'{wanted}' names {len(found)} nodes:", *lines, *more])
