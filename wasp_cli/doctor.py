"""What this machine has, and what that means for a run."""

from __future__ import annotations

import ctypes.util
import os
import platform
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

from wasp_cli.console import out
from wasp_cli.errors import StoreError
from wasp_cli.store.layout import Layout
from wasp_cli.store.provenance import installed, memory_gb, processor

NEEDED = ("mujoco", "gymnasium", "numpy", "stable-baselines3", "joblib", "pyarrow", "safetensors")
SMALL_MEMORY_GB = 4.0


@dataclass(frozen=True)
class Finding:
    """One thing that was looked for."""

    what: str
    state: Literal["ok", "missing", "optional"]
    found: str
    meaning: str = ""


def examine(results: Path) -> list[Finding]:
    """Look for everything that a run can use. Imports torch and MuJoCo."""
    return [*_software(), *_hardware(), _graphics(), _writable(results)]


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
    yield Finding("cores", "ok", f"{count} ({processor()})", "`wasp run` starts as many workers; fewer with -j")
    memory = memory_gb()
    if memory is None:
        yield Finding("memory", "optional", "unknown", "about 2 GB per worker are enough for the preset cpu")
    else:
        small = memory < SMALL_MEMORY_GB
        yield Finding("memory", "missing" if small else "ok", f"{memory:g} GB", "use -j 1 and the preset quick" if small else "")
    yield _gpu()


def _gpu() -> Finding:
    try:
        torch = import_module("torch")  # by name: orchestration does not depend on it
    except (ImportError, OSError):
        return Finding("GPU", "optional", "unknown without torch")
    if torch.cuda.is_available():
        return Finding("GPU", "ok", torch.cuda.get_device_name(0), "the preset gpu can use it")
    return Finding("GPU", "optional", "none that torch can use", "everything runs on the CPU; presets quick and cpu are made for it")


def _graphics() -> Finding:
    found = [name for name in ("EGL", "OSMesa", "GL") if ctypes.util.find_library(name)]
    if found:
        return Finding("OpenGL", "ok", ", ".join(found), "only videos would use it")
    return Finding("OpenGL", "optional", "none", "not needed: the cameras cast rays without it")


def _writable(results: Path) -> Finding:
    # Looking must not create the folder: the nearest existing one tells as much.
    place = results.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    try:
        if place == results.absolute():
            Layout(place).prepare()
        elif not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
            raise StoreError(f"cannot make folders in '{place}'")
    except StoreError as error:
        return Finding("results", "missing", error.message, error.hint or "choose another folder with --results DIR")
    return Finding("results", "ok", f"'{results}' can be written")


def show(findings: list[Finding]) -> None:
    """Print findings as a table."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 2), show_header=False)
    colours = {"ok": "green", "missing": "bold red", "optional": "yellow"}
    words = {"ok": "ok", "missing": "missing", "optional": "none"}
    for finding in findings:
        state = Text(words[finding.state], style=colours[finding.state])
        table.add_row(Text(finding.what), state, Text(finding.found), Text(finding.meaning, style="dim"))
    out().print(table)
