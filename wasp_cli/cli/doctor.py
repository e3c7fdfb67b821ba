"""What this machine has, and what that means for a run."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

from wasp_cli.console import out
from wasp_cli.errors import WaspError
from wasp_cli.store.layout import Layout
from wasp_cli.store.provenance import installed, memory_gb, processor

NEEDED = ("mujoco", "gymnasium", "numpy", "stable-baselines3", "joblib", "pyarrow", "safetensors")
SMALL_MEMORY_GB = 4.0


@dataclass(frozen=True)
class Finding:
    """One thing that was looked for."""

    what: str
    state: Literal["ok", "missing", "low", "optional"]
    found: str
    meaning: str = ""


def examine(results: Path) -> list[Finding]:
    """Look for everything that a run can use. Imports torch and MuJoCo."""
    return [*_software(), *_hardware(), _writable(results)]


def _software() -> Iterator[Finding]:
    fits = sys.version_info >= (3, 11)
    yield Finding("Python", "ok" if fits else "missing", platform.python_version(), "" if fits else "wasp needs 3.11 or newer")
    yield _imported("torch", "torch")
    for name in NEEDED:
        yield _imported(name, name.replace("-", "_"))


def _imported(distribution: str, module: str) -> Finding:
    try:
        import_module(module)
    except (ImportError, OSError) as error:  # OSError: a library that the module loads is not there
        return Finding(distribution, "missing", str(error).partition("\n")[0], f"no stage runs without it: pip install {distribution}")
    return Finding(distribution, "ok", installed(distribution) or "found")


def _hardware() -> Iterator[Finding]:
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    yield Finding("cores", "ok", f"{count} ({processor()})", "`wasp run` starts at most as many workers; fewer with -j")
    memory = memory_gb()
    if memory is None:
        yield Finding("memory", "optional", "unknown", "about 2 GB per worker are enough for the preset cpu")
    else:
        small = memory < SMALL_MEMORY_GB
        yield Finding("memory", "low" if small else "ok", f"{memory:g} GB", "use -j 1 and the preset quick" if small else "")
    yield _gpu()


def _gpu() -> Finding:
    try:
        import torch
    except (ImportError, OSError):
        return Finding("GPU", "optional", "unknown without torch")
    if torch.cuda.is_available():
        return Finding("GPU", "ok", torch.cuda.get_device_name(0), "not used by this version yet; everything runs on the CPU")
    return Finding("GPU", "optional", "none that torch can use", "not needed: everything runs on the CPU")


def _writable(results: Path) -> Finding:
    for folder in (results.absolute(), *Layout(results.absolute()).needed()):
        # Looking must not create anything: the nearest existing folder tells as much.
        place = folder
        while not os.path.lexists(place) and place != place.parent:
            place = place.parent
        if not os.path.isdir(place):
            return Finding("results", "missing", f"'{place}' is no folder", "choose another folder with --results DIR")
        if not os.access(place, os.W_OK | os.X_OK):
            return Finding("results", "missing", f"cannot write to '{place}'", "choose another folder with --results DIR")
    return Finding("results", "ok", f"'{results}' can be written")


def require(findings: list[Finding]) -> None:
    """Raise when something is missing without which nothing runs.

    Raises:
        WaspError: naming it.
    """
    if missing := [finding.what for finding in findings if finding.state == "missing"]:
        raise WaspError(f"no run is possible here yet: {', '.join(missing)}", "the table says what each needs")


def show(findings: list[Finding]) -> None:
    """Print findings as a table."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 2), show_header=False)
    colours = {"ok": "green", "missing": "bold red", "low": "yellow", "optional": "yellow"}
    words = {"ok": "ok", "missing": "missing", "low": "low", "optional": "none"}
    for finding in findings:
        state = Text(words[finding.state], style=colours[finding.state])
        table.add_row(Text(finding.what), state, Text(finding.found), Text(finding.meaning, style="dim"))
    out().print(table)
