"""Figures that are there already: drawing takes longer than everything else of a run that has nothing to compute.

A report's folder has `.figures.json`: a mark of all that the figures were drawn from, and the SHA-256 of each. Where the mark is the same
and no file has changed, nothing is drawn.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from wasp_cli.report.stats.frame import Frame
from wasp_cli.store.artifact import file_digest, replace_file
from wasp_cli.store.plain import parse, read_plain

KEPT = ".figures.json"
_ROOM = Path(__file__).parents[1]


def mark_of(frame: Frame, sources: Iterable[Path]) -> str:
    """Return a mark of the numbers in a frame, of files by their place, time and size, and of the code that draws.

    Args:
        frame: the cells.
        sources: folders whose files are drawn too.
    """
    digest = hashlib.sha256(version("matplotlib").encode())

    def add(value: Any) -> None:
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else f"{value!r};".encode())

    for cell in frame.cells:
        add((cell.identity, cell.severity, sorted(cell.pooled.items()), cell.thresholds))
        for name, values in sorted(cell.episodes.items()):
            add(name)
            add(values)
    for identity, judged in frame.judged.items():
        add((identity, judged.window, judged.tau_R))
        for column in (*judged.worth, judged.episode):
            add(column)
    add((frame.order, frame.missing, frame.unbranched))
    for folder in sources:
        for path in sorted(folder.glob("*")):
            with suppress(OSError):
                add((str(path), path.stat().st_mtime_ns, path.stat().st_size))
    for path in sorted(_ROOM.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def drawn_before(folder: Path, mark: str) -> list[Path] | None:
    """Return the figures of a report if they were drawn from the same and are unchanged; else None."""
    with suppress(OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        known: Mapping[str, Any] = parse(read_plain(folder / KEPT))
        files: Mapping[str, str] = known["files"]
        plain = all(Path(name).name == name and not (folder / name).is_symlink() and (folder / name).is_file() for name in files)
        if known["mark"] == mark and plain and all(file_digest(folder / name) == digest for name, digest in files.items()):
            return [folder / name for name in files]
    return None


def keep(folder: Path, mark: str, files: Sequence[Path]) -> None:
    """Remember from what figures were drawn; a folder that cannot be written costs the next report its time and nothing else."""
    with suppress(OSError):
        listed = {path.name: file_digest(path) for path in files}
        # Their order is that of the page: JSON that people read sorts its names.
        replace_file(folder / KEPT, json.dumps({"mark": mark, "files": listed}, indent=1) + "\n")
