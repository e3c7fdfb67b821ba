"""Records of which process computes, by which others see whether it still lives."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any


def this_process() -> dict[str, object]:
    """Return pid, host and boot of this process, by which others can see whether it lives."""
    return {"pid": os.getpid(), "host": platform.node(), "boot": boot_id()}


def boot_id() -> str | None:
    """Return an id of the time since this machine started, which tells a process id from an older
    one; None if there is none.
    """
    with suppress(OSError, ValueError):
        # Linux only
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip() or None
    return None


def is_gone(record: Mapping[str, Any]) -> bool:
    """Return whether the process of a record (`pid`, `host`, `boot`) has ended; False if that
    cannot be seen from here.
    """
    pid = record.get("pid")
    boot = boot_id()
    if record.get("host") != platform.node() or not isinstance(pid, int) or not 0 < pid < 2**31:
        return False
    if boot is not None and isinstance(record.get("boot"), str) and record["boot"] != boot:
        return True
    try:
        os.kill(pid, 0)
    except OSError as error:  # without permission: the process exists, but is another user's
        return isinstance(error, ProcessLookupError)
    return False
