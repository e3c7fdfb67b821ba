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
    """Return where the specs are; pyproject.toml puts them into a wheel."""
    packaged = _PACKAGE / FOLDER
    return packaged if packaged.is_dir() else _PACKAGE.parent / FOLDER


def published_folder() -> Path | None:
    """Return where the published parts are, laid out as a results folder; None where the package
    came without them.

    They are copied, once, where nobody may write to the package. Raises StoreError where they
    have to be, and cannot.
    """
    folder = packaged_folder()
    return folder and unpackable(folder)


def packaged_folder() -> Path | None:
    """Return where the package has the published parts, which may be for nobody to write to."""
    folders = (_PACKAGE / "published", _PACKAGE.parent / "results" / "published")
    return next((folder for folder in folders if (folder / "store").is_dir()), None)


def published_contents() -> Contents:
    """Return what the published parts hold, as it was counted at the release. No artifact is
    looked at, and nothing is unpacked. Empty where the package came without them.
    """
    folder = packaged_folder()
    if folder is None or not (folder / CONTENTS).is_file():
        return Contents()
    counted = json.loads((folder / CONTENTS).read_text(encoding="utf-8"))
    return Contents(cells=counted["cells"], specs=counted["specs"])


def shipped_names() -> list[str]:
    """Return the names of the specs that come with the package: `quickstart`, `away`,
    `away/lunar_lander`.
    """
    folder = specs_folder()
    alone = [path.stem for path in folder.glob(f"*{SUFFIX}") if path.stem != PAPER]
    grouped = [_name_in_group(path) for path in folder.glob(f"*/*{SUFFIX}")]
    return sorted([*alone, *grouped])


def _name_in_group(path: Path) -> str:
    """Return the name of a spec that lies in a folder with others. One that is called as the folder
    stands for it.
    """
    group = path.parent.name
    return group if path.stem == group else f"{group}/{path.stem}"


def spec_path(typed: Path, folder: Path = Path()) -> Path:
    """Return the file that was meant by a file or a name: the typed one in `folder`, else one of
    that name there or in its `specs/`, else the one that comes with the package. A folder is none.
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
    """Copy the specs with their modules, the paper's numbers and the schema for editors; returns
    what was written, and what was there and stays.
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
