"""The folder of one run: what was asked for, as a later report or a curious person needs it."""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.plan.cell import Cell
from wasp_cli.plan.part import Part
from wasp_cli.plan.plan import Plan
from wasp_cli.spec.load import Loaded
from wasp_cli.spec.model import Spec, spec_type
from wasp_cli.spec.names import RECORDED
from wasp_cli.store.artifact import read_record, write_record
from wasp_cli.store.layout import Layout


@dataclass(frozen=True)
class Recorded:
    """What a run was asked for."""

    run_id: str
    spec: Spec
    cells: list[tuple[Cell, str]]
    """Each cell with the key of its artifact."""
    parts: list[tuple[Part, str]]
    """Each trained part with the key of its artifact."""


def new_run(layout: Layout, loaded: Loaded, plan: Plan) -> str:
    """Make the folder of a new run and write down what it is asked for."""
    spec = loaded.spec
    run_id = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{spec.name[:60]}-{secrets.token_hex(2)}"
    folder = layout.run(run_id)
    try:
        for part in ("logs", "running"):
            (folder / part).mkdir(parents=True)
        (folder / "spec.yaml").write_text(loaded.source.text, encoding="utf-8")
        write_record(folder / "spec.json", spec.model_dump(mode="json"))
        write_record(folder / "plan.json", {"spec": spec.name, **plan.as_json()})
    except OSError as error:
        raise StoreError(f"cannot write to '{folder}': {(error.strerror or str(error)).lower()}") from error
    return run_id


def read_run(layout: Layout, run_id: str) -> Recorded:
    """What a run was asked for.

    Raises:
        ArtifactError: its record is damaged, or of another version.
    """
    folder = layout.run(run_id)
    try:
        spec = spec_type().model_validate_json((folder / "spec.json").read_bytes(), strict=True, context={RECORDED: True})
    except (OSError, ValidationError) as error:
        raise ArtifactError(f"cannot read the spec of run '{run_id}': {_first_line(error)}", "run the spec again") from error
    record: dict[str, Any] = read_record(folder / "plan.json") or {}
    try:
        cells = [(Cell(**_without_key(cell)), str(cell["key"])) for cell in record["cells"]]
        parts = [(Part(**_without_key(part)), str(part["key"])) for part in record.get("parts", ())]  # older runs name none
    except (KeyError, TypeError, AttributeError) as error:
        raise ArtifactError(f"cannot read the plan of run '{run_id}': {error!r}", "run the spec again") from error
    return Recorded(run_id, spec, cells, parts)


def _without_key(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in entry.items() if name != "key"}


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]


def results_of(folder: Path) -> Layout:
    """The layout of an existing results folder.

    Raises:
        StoreError: there is none, or it cannot be read.
    """
    layout = Layout(folder)
    try:
        os.scandir(layout.runs).close()
    except (FileNotFoundError, NotADirectoryError) as error:
        what = "it holds no runs" if os.path.exists(folder) else "no such folder"
        raise StoreError(f"no results in '{folder}': {what}", "wasp run SPEC --results DIR writes there") from error
    except OSError as error:
        raise StoreError(f"cannot read the results in '{folder}': {(error.strerror or str(error)).lower()}") from error
    return layout
