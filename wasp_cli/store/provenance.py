"""Where an artifact came from: source, versions, hardware. Recorded beside results, never part of a key."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import wasp_cli

RECORDED = ("torch", "mujoco", "numpy", "gymnasium", "stable-baselines3", "joblib", "pyarrow", "safetensors")


@cache
def provenance() -> dict[str, Any]:
    """What every artifact of this process shares."""
    return {
        "wasp": wasp_cli.__version__,
        "git": git_state(),
        "python": platform.python_version(),
        "versions": {name: installed(name) for name in RECORDED},
        "platform": platform.platform(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "memory_gb": memory_gb(),
        "host": platform.node(),
        "command": " ".join(sys.argv),
    }


def installed(name: str) -> str | None:
    """Version of an installed distribution."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def git_state() -> dict[str, Any] | None:
    """Commit of the source tree that runs and whether it was changed since; None outside a checkout."""
    root = Path(wasp_cli.__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        sha = _git(root, "rev-parse", "HEAD")
        return {"sha": sha, "dirty": bool(_git(root, "status", "--porcelain", "--untracked-files=no"))}
    except (OSError, subprocess.SubprocessError):  # no git on this machine, or a damaged checkout
        return None


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=10, check=True)
    return done.stdout.strip()


def processor() -> str:
    """Name of the processor."""
    details = Path("/proc/cpuinfo")  # Linux only
    if details.is_file():
        for line in details.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def memory_gb() -> float | None:
    """Main memory in GB."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    except (ValueError, OSError, AttributeError):
        return None
