"""Which process computes, and whether it still lives: written down here, read by others."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any


def this_process() -> dict[str, object]:
    """Name this process, so that others can see whether it lives."""
    return {"pid": os.getpid(), "host": platform.node(), "boot": boot_id()}


def boot_id() -> str | None:
    """Name the time since this machine started, so that a process id can be told from an older
    one; None where unknown.
    """
    with suppress(OSError, ValueError):
        # Linux only
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip() or None
    return None


def is_gone(record: Mapping[str, Any]) -> bool:
    """Return whether the process of a record (`pid`, `host`, `boot`) does not exist any more;
    False where that cannot be seen from here.
    """
    pid = record.get("pid")
    boot = boot_id()
    if record.get("host") != platform.node() or not isinstance(pid, int) or not 0 < pid < 2**31:
        return False
    if boot is not None and isinstance(record.get("boot"), str) and record["boot"] != boot:
        return True
    try:
        os.kill(pid, 0)
    except OSError as error:  # another one: it is somebody else's, but there
        return isinstance(error, ProcessLookupError)
    return False
