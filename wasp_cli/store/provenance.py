"""Where an artifact came from: source, versions, hardware. Recorded beside results, never part
of a key.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import wasp_cli

RECORDED = (
    "torch",
    "mujoco",
    "numpy",
    "gymnasium",
    "stable-baselines3",
    "joblib",
    "pyarrow",
    "safetensors",
)
CHANGES_LENGTH = 16  # hexadecimal digits of the hash of what was changed


@cache
def provenance() -> dict[str, Any]:
    """Return what every artifact of a run shares."""
    return {"wasp": wasp_cli.__version__, "git": git_state(), "command": " ".join(sys.argv)}


def machine() -> dict[str, Any]:
    """Return where this process computes: a worker on another machine of a cluster says its own."""
    return {
        "python": platform.python_version(),
        "versions": {name: installed(name) for name in RECORDED},
        "platform": platform.platform(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "memory_gb": memory_gb(),
        "host": platform.node(),
    }


def installed(name: str) -> str | None:
    """Return the version of an installed package; None where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def git_state() -> dict[str, Any] | None:
    """Return the commit of the source tree that runs, whether it was changed since, and a hash of
    what was changed; None outside a checkout.

    `dirty`: any tracked file differs, or the package has a Python file that is not tracked.
    `changes` tells two such runs apart: a hash over the names and contents of what differs in the
    package; None where only other files differ, such as a README.
    """
    package = Path(wasp_cli.__file__).resolve().parent
    root = package.parent
    if not (root / ".git").exists():
        return None
    try:
        sha = _git(root, "rev-parse", "HEAD").strip()
        changed = _git(root, "diff", "--name-only", "--no-renames", "-z", "HEAD").split("\0")[:-1]
        added = _git(
            root, "ls-files", "--others", "--exclude-standard", "-z", "--", f"{package.name}/*.py"
        ).split("\0")[:-1]
    except (OSError, ValueError, subprocess.SubprocessError):
        # no git on this machine, or a damaged checkout
        return None
    own = [name for name in changed if name.startswith(f"{package.name}/")]
    return {
        "sha": sha,
        "dirty": bool(changed or added),
        "changes": _hash_of_files(root, own + added),
    }


def _git(root: Path, *arguments: str) -> str:
    # Without optional locks: to look at a checkout must not make someone's commit in it fail.
    environment = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}
    command = ["git", "-C", str(root), *arguments]
    done = subprocess.run(
        command,
        capture_output=True,
        errors="surrogateescape",
        timeout=10,
        check=True,
        env=environment,
    )
    return done.stdout


def _hash_of_files(root: Path, names: list[str]) -> str | None:
    """A hash over names and contents; None of no files. The text of a diff would not do: it depends
    on each user's settings of git.
    """
    if not names:
        return None
    digest = hashlib.sha256()
    for name in sorted(set(names)):
        try:
            content = (root / name).read_bytes()
        except OSError:  # removed, or a folder that is a repository of its own
            content = b""
        digest.update(
            f"{name}\0{hashlib.sha256(content).hexdigest()}\n".encode(errors="surrogateescape")
        )
    return digest.hexdigest()[:CHANGES_LENGTH]


def cuda_devices() -> list[str]:
    """Return the names of the CUDA devices that this process computes on; empty where it does not.

    It never imports torch, and does not ask an idle device for its name: that would reserve
    hundreds of megabytes on it.
    """
    cuda = getattr(sys.modules.get("torch"), "cuda", None)
    if cuda is None or not cuda.is_initialized():
        return []
    return [str(cuda.get_device_name(index)) for index in range(cuda.device_count())]


def processor() -> str:
    """Return its name and, where torch is loaded, the vector instructions of torch's kernels:
    both decide how results round.
    """
    name = platform.processor() or platform.machine()
    details = Path("/proc/cpuinfo")  # Linux only
    if details.is_file():
        text = details.read_text(encoding="utf-8", errors="replace")
        model = re.search(r"^model name\s*:\s*(.*\S)", text, re.MULTILINE)
        if model:
            name = model[1]
    torch = sys.modules.get("torch")
    return f"{name}, {torch.backends.cpu.get_cpu_capability()}" if torch else name


def memory_gb() -> float | None:
    """Return the memory of this machine in GB; None where the system does not tell it."""
    with suppress(ValueError, OSError, AttributeError):
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    return None
