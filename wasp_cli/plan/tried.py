"""Times of an environment that `wasp try` has measured on this machine, kept in the cache folder:
plans use them as long as no node of the environment was computed.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from wasp_cli.spec.cache import folders, make
from wasp_cli.tasks.declared import declaration_of, text_of

FOLDER = "tried"


@dataclass(frozen=True)
class Tried:
    """Times are wall times on this machine, one env step after the other."""

    step_seconds: float  # of an env step with what assistants see
    bare_seconds: float  # the same where nobody looks at an image
    length: float  # env steps of an episode of the simple driver that lasts longest


def keep(name: str, found: Tried) -> Path | None:
    """Keep the times of a task. Returns the file, or None if no cache folder can be written."""
    for folder in folders():
        with suppress(OSError):
            make(folder)
            path = folder / FOLDER / _file(name)
            path.parent.mkdir(exist_ok=True)
            text = json.dumps({"task": name, "machine": _machine(), **asdict(found)}, indent=1)
            aside = path.with_suffix(f".{os.getpid()}")
            aside.write_text(text, encoding="utf-8")
            aside.replace(path)
            return path
    return None


def kept(name: str) -> Tried | None:
    """Return the times that were measured here for a task, as it is declared now; None if there are
    none, or they cannot be read.
    """
    for folder in folders():
        with suppress(OSError, ValueError, KeyError, TypeError):
            record = json.loads((folder / FOLDER / _file(name)).read_text(encoding="utf-8"))
            values = {field: float(record[field]) for field in Tried.__dataclass_fields__}
            return Tried(**values)
    return None


def _file(name: str) -> str:
    identity = json.dumps([name, text_of(declaration_of(name)), _machine()])
    return f"{hashlib.sha256(identity.encode()).hexdigest()[:20]}.json"


def _machine() -> str:
    return f"{platform.node()} {platform.machine()}"
