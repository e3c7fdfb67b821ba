"""The specs and the published parts that come with the package: in a checkout the folders of the
repository, in a wheel copies of them.

wasp run quickstart                  a spec by its name, from any folder
wasp run away                        one that has a folder for itself and its modules
wasp run away/lunar_lander           another one of that folder
wasp run specs/quickstart.yaml       the same; a file that is there comes first
extends: quickstart                  the same inside a spec, where paths begin at the folder of its
file
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from wasp_cli.errors import UsageError
from wasp_cli.spec.cache import unpackable

_PACKAGE = Path(__file__).parents[1]
SUFFIX = ".yaml"
FOLDER = "specs"
PAPER = "paper"  # lies beside the specs and is none
CONTENTS = "contents.json"  # beside the published parts; docs/examples/published.py writes it


@dataclass(frozen=True)
class Contents:
    """What the package has of published results."""

    cells: int = 0
    """All evaluated cells: a method with an operator, in one training on one task."""
    specs: Mapping[str, int] = field(default_factory=dict)
    """By spec, how many of its cells a run takes from there. Specs share cells."""


def specs_folder() -> Path:
    """Return the folder of the specs that come with the package; pyproject.toml puts them into a
    wheel.
    """
    packaged = _PACKAGE / FOLDER
    return packaged if packaged.is_dir() else _PACKAGE.parent / FOLDER


def published_folder() -> Path | None:
    """Return the folder of the published parts, laid out as a results folder; None if the package
    came without them. If the user may not write to the package, it is a copy in the cache folder.

    Raises:
        StoreError: a copy is needed, and cannot be made.
    """
    folder = packaged_folder()
    return folder and unpackable(folder)


def packaged_folder() -> Path | None:
    """Return the folder of the published parts in the package, which may be read-only; None without
    any.
    """
    folders = (_PACKAGE / "published", _PACKAGE.parent / "results" / "published")
    return next((folder for folder in folders if (folder / "store").is_dir()), None)


def published_contents() -> Contents:
    """Return what the published parts contain, as counted at the release. No artifact is read, and
    nothing is unpacked. It is empty if the package came without them.
    """
    folder = packaged_folder()
    if folder is None or not (folder / CONTENTS).is_file():
        return Contents()
    counted = json.loads((folder / CONTENTS).read_text(encoding="utf-8"))
    return Contents(cells=counted["cells"], specs=counted["specs"])


def shipped_names() -> list[str]:
    """Return the names of the specs that come with the package, such as `quickstart`, `away` and
    `away/lunar_lander`.
    """
    folder = specs_folder()
    alone = [path.stem for path in folder.glob(f"*{SUFFIX}") if path.stem != PAPER]
    grouped = [_name_in_group(path) for path in folder.glob(f"*/*{SUFFIX}")]
    return sorted([*alone, *grouped])


def _name_in_group(path: Path) -> str:
    """The name of a spec in a folder of specs. The one that is named like its folder has the name
    of the folder.
    """
    group = path.parent.name
    return group if path.stem == group else f"{group}/{path.stem}"


def spec_path(typed: Path, folder: Path = Path()) -> Path:
    """Return the file that a file or a name means: the typed one in `folder`, else one of that name
    there or in its `specs/`, else the one that comes with the package. Folders do not count.
    """
    path = folder / typed
    there = os.path.exists(path) and not os.path.isdir(path)
    if there or typed.suffix not in ("", SUFFIX) or not typed.stem.isprintable():
        return path
    name = typed.stem + SUFFIX
    if str(typed.parent) in (".", FOLDER):
        candidates = [
            folder / typed.parent / name,
            folder / FOLDER / name,
            specs_folder() / name,
            specs_folder() / typed.stem / name,
        ]
    elif f"{typed.parent}/{typed.stem}" in shipped_names():
        candidates = [folder / typed.parent / name, specs_folder() / typed.parent / name]
    else:
        return path
    for candidate in candidates:
        if os.path.isfile(candidate):
            return candidate
    return path


def copy_specs(folder: Path) -> tuple[list[Path], list[Path]]:
    """Copy the specs with their modules, the paper's numbers and the schema for editors. Files that
    exist are not replaced.

    Returns:
        The files that were written, and those that exist.

    Raises:
        UsageError: this installation has no specs.
    """
    source = specs_folder()
    if not source.is_dir():
        raise UsageError(
            f"this installation has no specs: '{source}' is not there",
            "install the package from a wheel or a checkout",
        )
    patterns = (f"*{SUFFIX}", "*.schema.json", f"*/*{SUFFIX}", "*/*.py")
    sources = sorted(path for pattern in patterns for path in source.glob(pattern))
    targets = {folder / path.relative_to(source): path for path in sources}
    kept = [target for target in targets if target.exists()]
    written = [target for target in targets if target not in kept]
    for target in written:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(targets[target], target)
    return written, kept
