"""A run without its terminal: a child in a session of its own, which says where it is as soon as its folder is there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wasp_cli.store.layout import Layout

TOLD = "WASP_DETACHED"
"""Names, to the child, the file in which it says where it is."""
POLL_SECONDS = 0.05


def detached(arguments: Sequence[str]) -> tuple[Mapping[str, Any] | None, int, str]:
    """Start this program again without the terminal, and wait until its run has begun or it has ended.

    Args:
        arguments: of the command line.

    Returns:
        What it says of its run (None where it ended without one), its exit code (0 while it goes on), and what it printed until then.
    """
    # As a module where it was started so: the folder of a package is no place to import from.
    own = Path(sys.argv[0])
    program = ["-m", "wasp_cli"] if own.name == "__main__.py" else [str(own)]
    with tempfile.TemporaryDirectory(prefix="wasp-") as folder:
        told, log = Path(folder) / "run.json", Path(folder) / "terminal.log"
        with log.open("w", encoding="utf-8") as stream:
            process = subprocess.Popen(
                [sys.executable, "-P", *program, *arguments],
                stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, start_new_session=True, env={**os.environ, TOLD: str(told)},
            )  # fmt: skip
        while not told.exists() and process.poll() is None:
            time.sleep(POLL_SECONDS)
        said = json.loads(told.read_text(encoding="utf-8")) if told.exists() else None
        return said, process.poll() or 0, log.read_text(encoding="utf-8", errors="replace")


def announce(layout: Layout, run_id: str, spec: str) -> None:
    """Say where this run is, where somebody has started it without a terminal and waits to hear; from then on it prints to its folder."""
    told = os.environ.pop(TOLD, None)
    if told is None:
        return
    log = layout.run(run_id).absolute() / "terminal.log"
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    for number in (1, 2):
        os.dup2(descriptor, number)
    os.close(descriptor)
    said = {"spec": spec, "run": run_id, "folder": str(log.parent), "pid": os.getpid(), "log": str(log)}
    written = Path(told + ".part")
    written.write_text(json.dumps(said), encoding="utf-8")
    written.rename(told)  # whole, or not there
