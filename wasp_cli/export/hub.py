"""A published folder as a folder for a hub, or as an archive of it: weights as safetensors, rows, a
card that says what to expect, and `config.json`.

`wasp_cli.load_assistant(FOLDER, ...)` and `wasp_cli.load_world_model(FOLDER, ...)` read it from its
path alone. The same published folder gives the same bytes.
"""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import distribution
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Template

import wasp_cli
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.export.folders import new_folder
from wasp_cli.notebook.stored_assistants import StoredAssistant, stored_assistants
from wasp_cli.run.verify import EVALUATE, why_not
from wasp_cli.store import artifact, records
from wasp_cli.store.layout import Layout
from wasp_cli.store.packs import tar_of
from wasp_cli.store.tables import cell_file, read_episodes

ENDING = ".tar.gz"
OTHER_ARCHIVES = (".zip", ".tar", ".tgz", ".gz", ".xz", ".bz2", ".7z")
WORLD_MODEL = "world_model"
VERIFIED = 30  # cells that the card computes again at most


@dataclass(frozen=True)
class ListedAssistant:
    """An assistant as the card lists it. Numbers are means over the episodes of its cells."""

    name: str  # as `load_assistant` takes it
    stored: StoredAssistant
    cells: int
    episodes: int
    return_: float
    cost: float
    interventions: float  # share of the decisions


@dataclass(frozen=True)
class ListedModel:
    """A world model as the card lists it."""

    label: str
    folder: str  # below the root


def require_archive(place: Path) -> None:
    """See that an archive, or a folder for a hub, can have this name. Raises UsageError."""
    is_archive = place.name.endswith(ENDING)
    if not is_archive and place.suffix in OTHER_ARCHIVES:
        raise UsageError(
            f"'{place}' is no name of an archive",
            f"it ends with {ENDING}: {place.name.partition('.')[0] or 'mine'}{ENDING}; any other "
            "name is that of a folder",
        )
    if is_archive and not artifact.is_file_name(place.name.removesuffix(ENDING)):
        raise UsageError(f"'{place}' is no name of an archive", f"it ends with {ENDING}")
    if not place.absolute().parent.is_dir():
        raise UsageError(f"'{place.parent}' is no folder", "make it, or name another file")
    if place.is_dir() and not is_archive and not any(place.iterdir()):
        return
    if place.exists():
        raise UsageError(f"'{place}' is there already", "remove it, or name another file")


def write_archive(target: Layout, name: str, place: Path) -> int:
    """Write a published folder as an archive, or as a folder for a hub.

    Args:
        target: of the published folder.
        name: of the spec.
        place: a `.tar.gz`, whose folder has the rest of its name; any other name is that of a
            folder.

    Returns:
        The number of files in it.

    Raises:
        StoreError: nothing is published.
        OSError: it cannot be written; nothing is left of it.
    """
    if not place.name.endswith(ENDING):
        members = hub_members(target, name, place)
        with new_folder(place) as staged:
            for member, data in members.items():
                path = staged / member
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
        return len(members)
    members = hub_members(target, name, None)
    folder = place.name.removesuffix(ENDING)
    archive = tar_of({f"{folder}/{member}": data for member, data in sorted(members.items())})
    records.replace_file(place, gzip.compress(archive, mtime=0))
    return len(members)


def hub_members(target: Layout, name: str, folder: Path | None) -> dict[str, bytes]:
    """Return the files of a folder for a hub, by name. Arguments and errors as of `write_archive`;
    `folder` is what the card uploads, None of an archive.
    """
    # -- what is published, without links
    if not target.store.is_dir():
        raise StoreError(f"nothing is published in '{target.root}'")
    published = [part for part in (target.store, target.root / "reports") if part.is_dir()]
    paths = sorted(
        path
        for part in published
        for path in part.rglob("*")
        if path.is_file() and not path.is_symlink()
    )
    members = {path.relative_to(target.root).as_posix(): path.read_bytes() for path in paths}

    # -- what is said of it
    cells = sorted(artifact.stored_keys(target, EVALUATE))
    assistants = listed_assistants(target)
    models = listed_models(target)
    template = Template(
        files("wasp_cli.export").joinpath("card.md").read_text(encoding="utf-8"),
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    card = template.render(
        name=name,
        version=wasp_cli.__version__,
        rows=list(_kinds(target)),
        assistants=assistants,
        world_models=models,
        episodes=_count_rows(target, cells),
        again=min(VERIFIED, sum(why_not(target, key) is None for key in cells)),
        folder=None if folder is None else folder.name,
    )
    config = records.dumps(_config(target, name, assistants, models))
    members |= {
        "README.md": card.encode(),
        "config.json": config.encode(),
        "LICENSE": _licence().read_bytes(),
    }

    # -- sums of all that
    sums = "".join(
        f"{hashlib.sha256(data).hexdigest()}  {member}\n"
        for member, data in sorted(members.items())
    )
    return {**members, "SHA256SUMS": sums.encode()}


def listed_assistants(target: Layout) -> list[ListedAssistant]:
    """Return the evaluated assistants whose models are all in a folder, by name."""
    listed: list[ListedAssistant] = []
    whole = [one for one in stored_assistants(target) if one.cells and _is_here(target, one)]
    labels = [one.label for one in whole]
    for one in whole:
        keys = sorted(source.key for source in one.sources if source.kind == EVALUATE)
        rows = read_episodes([cell_file(target.artifact(EVALUATE, key)) for key in keys])
        listed.append(
            ListedAssistant(
                # Where two have one label, the key of a cell says which is meant.
                one.label if labels.count(one.label) == 1 else keys[0],
                one,
                len(keys),
                len(rows),
                float(np.mean(rows["return"])),
                float(np.mean(rows["cost"])),
                float(np.mean(rows["int_rate"])),
            )
        )
    return sorted(listed, key=lambda one: (one.stored.label, one.name))


def listed_models(target: Layout) -> list[ListedModel]:
    """Return the world models of a folder, by label."""
    models: list[ListedModel] = []
    for key in sorted(artifact.stored_keys(target, WORLD_MODEL)):
        if artifact.exists(target, WORLD_MODEL, key):
            manifest = artifact.read_manifest(target, WORLD_MODEL, key)
            folder = target.artifact(WORLD_MODEL, key).relative_to(target.root).as_posix()
            models.append(ListedModel(str(manifest.get("label", "")), folder))
    return sorted(models, key=lambda model: (model.label, model.folder))


def _is_here(target: Layout, one: StoredAssistant) -> bool:
    """Whether every model of an assistant is in the folder, and none elsewhere on this machine."""
    return all(artifact.exists(target, kind, key) for kind, key in one.inputs.values())


def _config(
    target: Layout,
    name: str,
    assistants: Sequence[ListedAssistant],
    models: Sequence[ListedModel],
) -> Mapping[str, Any]:
    """What the folder holds, for programs."""
    return {
        "library_name": "wasp-cli",
        "library_version": wasp_cli.__version__,
        "name": name,
        "assistants": [
            {
                "name": one.name,
                "task": one.stored.task,
                "training": one.stored.seed,
                "method": one.stored.method,
                "settings": dict(one.stored.settings),
                "models": {
                    needed: target.artifact(kind, key).relative_to(target.root).as_posix()
                    for needed, (kind, key) in sorted(one.stored.inputs.items())
                },
                "expected": {
                    "cells": one.cells,
                    "episodes": one.episodes,
                    "return": one.return_,
                    "cost": one.cost,
                    "int_rate": one.interventions,
                },
            }
            for one in assistants
        ],
        "world_models": [{"label": model.label, "folder": model.folder} for model in models],
    }


def _count_rows(target: Layout, cells: Sequence[str]) -> int:
    """How many episodes the cells have."""
    return len(read_episodes([cell_file(target.artifact(EVALUATE, key)) for key in cells]))


def _kinds(target: Layout) -> Iterator[tuple[str, int, str]]:
    """By kind, how many artifacts there are, and of which tasks."""
    for kind in sorted(artifact.stored_kinds(target)):
        keys = artifact.stored_keys(target, kind)
        tasks = {str(artifact.read_manifest(target, kind, key).get("task")) for key in keys}
        yield kind, len(keys), ", ".join(sorted(tasks))


def _licence() -> Path:
    """Our licence, of a checkout or of the installed package."""
    root = Path(__file__).parents[2]
    if (root / "pyproject.toml").is_file():
        return root / "LICENSE"
    installed = distribution("wasp-cli").files or ()
    return Path(str(next(file.locate() for file in installed if file.name == "LICENSE")))
