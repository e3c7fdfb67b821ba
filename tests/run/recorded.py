"""Run folders written by hand: what a run leaves behind, in any state."""

import json
import platform
import subprocess
import sys
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from typing import Any

from wasp_cli.run.process import boot_id
from wasp_cli.store.layout import Layout
from wasp_cli.store.records import write_record

START = datetime(2026, 5, 1, 12, 0, tzinfo=UTC)


def key(number: int) -> str:
    return f"{number:020x}"


def at(seconds: float) -> str:
    return (START + timedelta(seconds=seconds)).isoformat(timespec="milliseconds")


def planned(
    number: int, label: str, state: str = "missing", needs: Iterable[int] = (), **further: Any
) -> dict[str, Any]:
    needed = {f"need{index}": key(index) for index in needs}
    return {
        "key": key(number),
        "kind": "expert",
        "label": label,
        "state": state,
        "reason": "",
        "needs": needed,
        **further,
    }


def process(pid: int) -> dict[str, Any]:
    return {"pid": pid, "host": platform.node(), "boot": boot_id()}


def dead_pid() -> int:
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    return done.pid


def write_run(
    layout: Layout,
    run_id: str,
    nodes: list[dict[str, Any]],
    events: Iterable[tuple[float, str, dict[str, Any]]] | None = None,
    running: dict[int, dict[str, Any]] | None = None,
    spec: str = "small",
) -> None:
    """The folder of a run; without events it has no journal."""
    folder = layout.run(run_id)
    for part in ("logs", "running"):
        (folder / part).mkdir(parents=True)
    write_record(
        folder / "plan.json",
        {"spec": spec, "nodes": nodes, "cells": [], "branched": [], "parts": []},
    )
    if events is not None:
        lines = [
            json.dumps({"at": at(seconds), "event": event, **facts})
            for seconds, event, facts in events
        ]
        (folder / "journal.jsonl").write_text(
            "".join(f"{line}\n" for line in lines), encoding="utf-8"
        )
    for number, record in (running or {}).items():
        write_record(layout.running(run_id, key(number)), record)
