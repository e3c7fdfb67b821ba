"""The data files of code of other packages, which can change results as much as its Python.

They are found in the source without running it, since Python does not notice files that C++ opens,
such as an XML model of MuJoCo. Files whose names are computed are found by `tasks.foreign.assets`,
which also defines the names of data files.
"""

from __future__ import annotations

import ast
import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from wasp_cli.store.reached import reached
from wasp_cli.tasks.foreign.assets import CODE, INSTALLED, MARK, files_below, is_hidden

EXTENSIONS = frozenset({".so", ".pyd", ".dylib"})
"""Suffixes of compiled modules, which have no source that a key could cover."""
LONGEST = 200
"""Characters of the longest text that is taken for a file name or a part of one."""
REFERRING = frozenset({".xml", ".mjcf", ".urdf", ".sdf", ".xacro"})
"""Suffixes of models that name further files."""
_REFERENCE = re.compile(rb"""\b\w*(?:file|filename|dir)\w*\s*=\s*["']([^"'<>]{1,200})["']""")
"""An attribute that names a file or a folder: `file`, `meshdir`, `fileright`, `filename`."""


class Texts(NamedTuple):
    """The texts of a module that may name files."""

    whole: frozenset[str]  # constants
    ends: frozenset[str]  # how names end: the text after the last value of an f-string, or `*.npz`
    declared: frozenset[str]  # of a list `assets = ["maps", "robot.xml"]`


def data_path(name: str, home: Path) -> Path:
    """Return where a data file lies; `home` is the folder of its top-level module."""
    return home / name.partition(MARK)[2]


def data_hash(path: Path) -> str:
    """Return a hash over the bytes of a file. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:12]


def data_files(tree: ast.Module, source: Path, home: Path) -> list[Path]:
    """Find the data files that a module names.

    Args:
        tree: its syntax.
        source: its file.
        home: the folder in which its top-level module lies.

    Returns:
        Files beside the module, in a folder above it within `home`, or in a folder there that
        the module names too, and what XML among them refers to; in the order of their paths.
    """
    texts = texts_of(tree)
    folders = _folders(source, home, texts)
    found: set[Path] = set()
    for folder in folders:
        found.update(_named(folder, home, texts))
        for text in texts.declared:
            found.update(files_below(folder / text))
    everything = reached(found, _referred)
    return sorted(file for file in everything if file.suffix not in CODE)


def texts_of(tree: ast.Module) -> Texts:
    """Return the texts of a module that may name files; docstrings are left out."""
    whole: set[str] = set()
    ends: set[str] = set()
    declared: set[str] = set()
    pending: list[ast.AST] = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            continue
        if isinstance(node, ast.JoinedStr):
            last = node.values[-1] if node.values else None
            if isinstance(last, ast.Constant) and isinstance(last.value, str):
                ends.add(last.value)
        if isinstance(node, ast.Assign | ast.AnnAssign) and _is_assets(node):
            declared.update(_texts(node.value))
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            whole.add(node.value)
        pending.extend(ast.iter_child_nodes(node))
    ends.update(text.rpartition("*")[2] for text in whole if "*" in text)
    ends.update(text for text in whole if text.startswith("."))
    return Texts(
        frozenset(filter(_may_be_a_path, whole)),
        frozenset(end for end in ends if re.fullmatch(r"[\w.-]{0,100}\.\w{1,20}", end)),
        frozenset(filter(_may_be_a_path, declared)),
    )


def _is_assets(node: ast.Assign | ast.AnnAssign) -> bool:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return any(isinstance(target, ast.Name) and target.id == "assets" for target in targets)


def _texts(node: ast.AST | None) -> Iterator[str]:
    for part in ast.walk(node) if node is not None else ():
        if isinstance(part, ast.Constant) and isinstance(part.value, str):
            yield part.value


def _may_be_a_path(text: str) -> bool:
    """Whether a text can be a relative path to a file that is not hidden."""
    if not 0 < len(text) <= LONGEST or not text.isprintable():
        return False
    if Path(text).is_absolute() or text.startswith("~"):
        return False
    return not any(part.startswith(".") and part != ".." for part in Path(text).parts)


def _folders(source: Path, home: Path, texts: Texts) -> list[Path]:
    """Return the folders in which a module's files are looked for."""
    above = [folder for folder in source.parents if folder == home or home in folder.parents]
    if home.name in INSTALLED:  # what others have installed is not part of this module
        above = [folder for folder in above if folder != home]
    folders = dict.fromkeys(above)
    for _ in range(2):  # `assets`, and `assets / "maps"`
        named = [folder / text for folder in folders for text in sorted(texts.whole)]
        folders |= dict.fromkeys(folder for folder in named if folder.is_dir())
    return list(folders)


def _named(folder: Path, home: Path, texts: Texts) -> Iterator[Path]:
    for text in texts.whole:
        if "." in Path(text).name and (folder / text).is_file():
            yield folder / text
    # Of a name that is computed only the end is known. Outside of `home` too much would match it.
    is_own = folder == home or home in folder.parents
    if texts.ends and is_own:
        ends = tuple(texts.ends)
        for path in folder.iterdir():
            if path.name.endswith(ends) and not is_hidden(path.name) and path.is_file():
                yield path


def _referred(file: Path) -> Iterable[Path]:
    """Return the files that an XML model names, whichever of its folders they lie in."""
    if file.suffix not in REFERRING:
        return []
    texts = [text.decode("utf-8", "replace") for text in _REFERENCE.findall(file.read_bytes())]
    folders = [file.parent, *(file.parent / text for text in texts)]
    paths = [folder / text for folder in folders for text in texts]
    return [path for path in paths if path.is_file()]
