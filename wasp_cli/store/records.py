"""Small JSON records: written beside their place, then moved there in one step."""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wasp_cli.errors import ArtifactError
from wasp_cli.store.plain import parse, read_plain


def write_record(path: Path, record: Mapping[str, Any], *, compact: bool = False) -> None:
    """Write a record, and make its folder where it is missing; a `compact` one, of thousands of
    lines, has them in one. Raises OSError where that fails.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, dumps(record, compact=compact))


def replace_file(path: Path, data: str | bytes) -> None:
    """Write a file in the place of a former one: readers see either, whole. Raises OSError where
    that fails; the former file then stays.
    """
    partial = path.with_name(f".{path.name}-{uuid.uuid4().hex[:8]}")
    try:
        partial.write_bytes(data.encode() if isinstance(data, str) else data)
        os.replace(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def read_record(path: Path) -> dict[str, Any] | None:
    """Return a record; None where there is no file. Raises ArtifactError where it is damaged."""
    try:
        record = parse(read_plain(path))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise ArtifactError(f"'{path}' is damaged: {error}", "remove it and run again") from error
    if not isinstance(record, dict):
        raise ArtifactError(f"'{path}' is damaged: not a JSON object", "remove it and run again")
    return record


def dumps(record: Mapping[str, Any], *, compact: bool = False) -> str:
    """Return a record as JSON that people can read, or in one line. Raises TypeError or ValueError
    for what has no JSON form, such as NaN: it must not be found out by a reader.
    """
    # in one line it is written several times as fast
    indent = None if compact else 1
    return json.dumps(record, indent=indent, sort_keys=True, allow_nan=False) + "\n"
