"""The logs of nodes: finding the one that a name means, and printing it."""

from __future__ import annotations

import io
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from wasp_cli.cells.runs import RunRecord
from wasp_cli.errors import StoreError, UnknownName, UsageError, WaspError
from wasp_cli.store.find import find_node
from wasp_cli.store.layout import Layout
from wasp_cli.store.named import matching, only, same_label
from wasp_cli.store.plain import open_plain, printable
from wasp_cli.store.published import FROM_PUBLISHED

_COLOUR = re.compile("(\x1b\\[[0-9;]*m)")


@dataclass(frozen=True)
class Log:
    """The log of a node in a run."""

    run_id: str
    key: str
    label: str
    path: Path


def find_log(layout: Layout, runs: list[RunRecord], text: str) -> Log:
    """Return the log that a label or the beginning of a key names: that of the newest run that has
    one.

    Raises:
        UnknownName: no node has this name.
        UsageError: several have it, or the node was not computed in a run of this folder.
    """
    name = " ".join(text.split())
    logs = [log for run in runs for log in _logs(layout, run)]
    matches = matching(logs, name)
    if matches and same_label(matches[0].label, name):
        # A label may have had another key in an older run; there it is another node's.
        keys = {log.key for log in matches if log.run_id == matches[0].run_id}
        matches = [log for log in matches if log.key in keys]
    # Empty logs come last: of runs that found the node computed by another run.
    matches.sort(key=lambda log: log.path.stat().st_size == 0)
    newest = {log.key: log for log in reversed(matches)}
    found = only(list(newest.values()), name, "nodes")
    if found is not None:
        return found
    try:
        node = find_node(layout, name)
    except WaspError:
        message = f"no log of '{name}' in '{layout.root}'"
        hint = "give a key or a label, as wasp status shows them"
        raise UnknownName(
            "node", name, {log.label for log in logs}, message, otherwise=hint
        ) from None
    how = "it was not computed in a run of this folder"
    if node.setting("provenance", FROM_PUBLISHED) is True:
        how = "it is a published result, computed elsewhere"
    raise UsageError(
        f"'{printable(node.label or name)}' has no log: {how}",
        f"wasp show {(node.key or '')[:8]} shows what is known of it",
    )


def write_log(log: Log, stream: TextIO) -> None:
    """Copy a log to a stream: unchanged to a file or a pipe; to a terminal without control
    sequences other than colours.

    Raises:
        StoreError: it cannot be read.
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
            # Only the last state of a progress bar; colours, but no other control sequences.
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
